variable "region" {
  description = "Region of AWS."
  type        = string

  validation {
    condition     = can(regex("^[a-z]{2}(-[a-z]+)+-[0-9]$", var.region))
    error_message = "region is one of AWS such as \"eu-central-1\"; a zone has a letter more."
  }
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

  validation {
    condition     = alltrue([for name in keys(var.sites) : can(regex("^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", name)) && name != "orchestrator"])
    error_message = "sites: names are lower-case letters, digits and '-', and none is \"orchestrator\", which is the other machine's."
  }
  validation {
    condition     = alltrue([for site in values(var.sites) : site.disk >= 20])
    error_message = "sites: disk is 20 GiB at least: images of services, and what robots leave."
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
