variable "orchestrator" {
  description = "Where the orchestrator takes nodes: https://HOST, or https://HOST:PORT if that is not 8603."
  type        = string
}

variable "cli" {
  description = "Words that run `skytether` as its operator; with `SKYTETHER_URL` and `SKYTETHER_TOKEN_FILE` in the environment it is run here."
  type        = list(string)
  default     = ["skytether"]
}

variable "machines" {
  description = "The machines, by the names of their sites: Debian 12, reached by SSH, with a user who may use sudo. `advertise` is the address that robots are told, if not `address`."
  type = map(object({
    address   = string
    user      = optional(string, "debian")
    port      = optional(number, 22)
    advertise = optional(string)
  }))

  validation {
    condition     = length(var.machines) > 0
    error_message = "machines has none: name one at least, { ward-3 = { address = \"192.0.2.7\" } }."
  }
  validation {
    condition     = alltrue([for machine in var.machines : can(regex("^[A-Za-z0-9.:-]+$", machine.address))])
    error_message = "machines: address is a host name or an address; the port of SSH is port."
  }
  validation {
    condition     = alltrue([for machine in var.machines : can(regex("^[a-z_][a-z0-9_-]*$", machine.user))])
    error_message = "machines: user is a user's name."
  }
  validation {
    condition     = alltrue([for machine in var.machines : machine.port >= 1 && machine.port <= 65535])
    error_message = "machines: port is that of SSH, from 1 to 65535."
  }
  validation {
    condition     = length(distinct([for machine in var.machines : "${machine.address} ${machine.port}"])) == length(var.machines)
    error_message = "machines: two have one address."
  }
}

variable "ssh_options" {
  description = "Options of ssh for all machines. The first visit believes the machine's key and later ones want the same; with `StrictHostKeyChecking=yes` it has to be in known_hosts before."
  type        = list(string)
  default     = ["-o", "StrictHostKeyChecking=accept-new", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"]
}

variable "ssh_from" {
  description = "Networks from which SSH stays open: yours among them, or the machines are out of your reach."
  type        = list(string)

  validation {
    condition     = length(var.ssh_from) > 0
    error_message = "ssh_from is empty: the firewall would close SSH, by which these machines are reached."
  }
}

variable "session_ports" {
  description = "First and last UDP port of sessions."
  type        = object({ first = number, last = number })
  default     = { first = 20000, last = 20099 }
}

variable "package" {
  description = "What pip installs, as in the module `node`."
  type = object({
    source  = string
    options = optional(list(string), [])
  })
  default = null
}

variable "images" {
  description = "Archives of images on the machines, as in the module `node`."
  type        = list(string)
  default     = []
}

variable "wait_minutes" {
  description = "How long a machine may take to answer and to join."
  type        = number
  default     = 30
}
