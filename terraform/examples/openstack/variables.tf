variable "cloud" {
  description = "Name in clouds.yaml. Null: the variables OS_* of the environment."
  type        = string
  default     = null
}

variable "region" {
  description = "Region of the cloud. Null: its only one."
  type        = string
  default     = null
}

variable "external_network" {
  description = "Name of the network that leads out, from which floating addresses are."
  type        = string
}

variable "image" {
  description = "Name of the image: Debian 12 with cloud-init (`genericcloud`)."
  type        = string
  default     = "debian-12"
}

variable "nameservers" {
  description = "Name servers of the private network. Empty: those of the cloud."
  type        = list(string)
  default     = []
}

variable "orchestrator" {
  description = "The orchestrator's machine: its flavour, and its availability zone."
  type = object({
    flavor = optional(string, "m1.small")
    zone   = optional(string)
  })
  default = {}
}

variable "sites" {
  description = "The sites, by their names: flavour, availability zone, and whether robots reach it at a floating address or are in its own network. None is good, too: sites elsewhere may join."
  type = map(object({
    flavor   = optional(string, "m1.large")
    zone     = optional(string)
    floating = optional(bool, true)
  }))
  default = {}

  validation {
    condition     = alltrue([for name in keys(var.sites) : can(regex("^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", name)) && name != "orchestrator"])
    error_message = "sites: names are lower-case letters, digits and '-', and none is \"orchestrator\", which is the other machine's."
  }
}

variable "robots_from" {
  description = "Networks in which robots are."
  type        = list(string)
  default     = ["0.0.0.0/0"]
}

variable "ssh_from" {
  description = "Networks from which you work: SSH is open to them, and Terraform brings tokens that way."
  type        = list(string)

  validation {
    condition     = length(var.ssh_from) > 0
    error_message = "ssh_from is empty: the operator's commands run on the orchestrator's machine, by SSH."
  }
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
