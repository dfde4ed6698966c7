variable "region" {
  description = "Region of AWS."
  type        = string
}

variable "orchestrator" {
  description = "The orchestrator's machine: its type, and the letter of its zone."
  type = object({
    machine_type = optional(string, "t3.small")
    zone         = optional(string, "a")
  })
  default = {}
}

variable "sites" {
  description = "The sites, by their names: type of the machine, letter of its zone, GiB of its disk. None is good, too: sites elsewhere may join."
  type = map(object({
    machine_type = optional(string, "c7i.xlarge")
    zone         = optional(string, "a")
    disk         = optional(number, 40)
  }))
  default = {}
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
