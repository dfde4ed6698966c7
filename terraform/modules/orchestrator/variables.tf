variable "name" {
  description = "Name of the machine."
  type        = string
  default     = "orchestrator"
}

variable "address" {
  description = "Host name or address at which robots, nodes and operators reach the API. It is in the certificate."
  type        = string

  validation {
    condition     = can(regex("^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$", var.address))
    error_message = "address is a host name or an address, without https:// and without a port."
  }
}

variable "more_names" {
  description = "Other host names and addresses by which it is asked, such as the private one of its network."
  type        = list(string)
  default     = []
}

variable "port" {
  description = "Port of the API (TCP), and of the echo for robots that measure (UDP)."
  type        = number
  default     = 8600

  validation {
    condition     = floor(var.port) == var.port && var.port >= 1024 && var.port <= 65535
    error_message = "port is a whole number from 1024 to 65535: the orchestrator is not root."
  }
}

variable "nodes_port" {
  description = "Port at which nodes call (TCP, always TLS, by certificates of the orchestrator's own making)."
  type        = number
  default     = 8603

  validation {
    condition     = floor(var.nodes_port) == var.nodes_port && var.nodes_port >= 1024 && var.nodes_port <= 65535 && var.nodes_port != var.port
    error_message = "nodes_port is a whole number from 1024 to 65535, and not port."
  }
}

variable "open" {
  description = "Who reaches the API, and where nodes call: the module `network`'s `open.orchestrator`. Null: everybody."
  type = list(object({
    protocol = string
    ports    = string
    from     = optional(list(string), ["0.0.0.0/0", "::/0"])
  }))
  default = null
}

variable "certificate" {
  description = "Files on the machine with a certificate and its key that something else renews (`certbot`, a cloud's agent), readable by the group `skytether`. Null: one that the machine makes itself at its first start."
  type        = object({ certificate = string, key = string })
  default     = null

  validation {
    condition     = var.certificate == null || (startswith(try(var.certificate.certificate, ""), "/") && startswith(try(var.certificate.key, ""), "/"))
    error_message = "certificate: both are absolute paths on the machine."
  }
}

variable "settings" {
  description = "More settings of the orchestrator (docs/configuration.md), as YAML. They are in the state: no password of a database."
  type        = string
  default     = "{}"

  validation {
    condition     = can(keys(yamldecode(var.settings)))
    error_message = "settings are a YAML document of keys and values."
  }
  validation {
    condition     = !can(yamldecode(var.settings).database_url) || !can(regex("://[^/@]*:[^/@]+@", yamldecode(var.settings).database_url))
    error_message = "settings.database_url has a password, which would be in Terraform's state: put SKYTETHER_DATABASE_URL into /etc/skytether/orchestrator.env on the machine."
  }
}

variable "package" {
  description = "What pip installs, as in the module `node`; with the extras `orchestrator` and `docker`."
  type = object({
    source  = string
    options = optional(list(string), [])
  })
  default = null
}

variable "ssh_user" {
  description = "User of the machine's image that may use sudo."
  type        = string
  default     = "debian"

  validation {
    condition     = can(regex("^[a-z_][a-z0-9_-]*$", var.ssh_user))
    error_message = "ssh_user is a user's name."
  }
}

variable "ssh_options" {
  description = "Options of ssh with which the operator reaches the machine."
  type        = list(string)
  default     = ["-o", "StrictHostKeyChecking=accept-new", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"]
}

variable "ssh_from" {
  description = "Networks from which SSH is let in, as in the module `node`; those at least of whoever makes sites."
  type        = list(string)
  default     = []
}

variable "ssh_keys" {
  description = "Public SSH keys of `ssh_user`."
  type        = list(string)
  default     = []
}

variable "reboot_at" {
  description = "As in the module `node`."
  type        = string
  default     = null
}
