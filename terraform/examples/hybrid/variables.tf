variable "region" {
  description = "Region of AWS."
  type        = string
}

variable "cloud_sites" {
  description = "Sites in the cloud, as `sites` of the example `aws`."
  type = map(object({
    machine_type = optional(string, "c7i.xlarge")
    zone         = optional(string, "a")
    disk         = optional(number, 40)
  }))
  default = {}
}

variable "edge_machines" {
  description = "Machines at the edge, as `machines` of the example `edge`."
  type = map(object({
    address   = string
    user      = optional(string, "debian")
    port      = optional(number, 22)
    advertise = optional(string)
  }))

  validation {
    condition     = length(setintersection(keys(var.edge_machines), keys(var.cloud_sites))) == 0
    error_message = "edge_machines: one has the name of a cloud site; names of sites are unique."
  }
}

variable "edge_ssh_from" {
  description = "Networks from which SSH stays open at the edge."
  type        = list(string)
}

variable "robots_from" {
  description = "Networks in which robots are."
  type        = list(string)
  default     = ["0.0.0.0/0"]
}

variable "ssh_from" {
  description = "Networks from which you work: SSH is open to them, and Terraform brings tokens that way."
  type        = list(string)
}

variable "ssh_key" {
  description = "Your public SSH key, a line as in id_ed25519.pub."
  type        = string
}

variable "session_ports" {
  description = "First and last UDP port of sessions at each site."
  type        = object({ first = number, last = number })
  default     = { first = 20000, last = 20099 }
}

variable "package" {
  description = "What pip installs on orchestrator and nodes, as in the module `node`; with the extras `orchestrator` and `docker`."
  type = object({
    source  = string
    options = optional(list(string), [])
  })
}
