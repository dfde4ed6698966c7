variable "cidr" {
  description = "The private network of orchestrator and nodes (IPv4)."
  type        = string
  default     = "10.86.0.0/16"

  validation {
    condition     = can(cidrnetmask(var.cidr)) && try(cidrhost(var.cidr, 0) == split("/", var.cidr)[0], false)
    error_message = "cidr is a network of IPv4 whose host part is 0, such as \"10.86.0.0/16\"."
  }
  validation {
    condition     = try(tonumber(split("/", var.cidr)[1]) >= 8 && tonumber(split("/", var.cidr)[1]) <= 24, false)
    error_message = "cidr is between /8 and /24: each zone gets a part of it."
  }
}

variable "zones" {
  description = "Names of the zones, each of which gets a subnet."
  type        = list(string)
  default     = ["a"]

  validation {
    condition     = length(var.zones) >= 1 && length(var.zones) <= 16 && length(distinct(var.zones)) == length(var.zones)
    error_message = "zones are 1 to 16 different names."
  }
}

variable "api_port" {
  description = "Port of the orchestrator's API (TCP), and of its echo for robots that measure (UDP)."
  type        = number
  default     = 8600

  validation {
    condition     = floor(var.api_port) == var.api_port && var.api_port >= 1 && var.api_port <= 65535
    error_message = "api_port is a whole number from 1 to 65535."
  }
}

variable "nodes_port" {
  description = "Port at which nodes call the orchestrator (TCP, always TLS; `nodes.port`)."
  type        = number
  default     = 8603

  validation {
    condition     = floor(var.nodes_port) == var.nodes_port && var.nodes_port >= 1 && var.nodes_port <= 65535 && var.nodes_port != var.api_port
    error_message = "nodes_port is a whole number from 1 to 65535, and not api_port."
  }
}

variable "nodes_from" {
  description = "Networks outside this one in which nodes are: sites at the edge call from there."
  type        = list(string)
  default     = ["0.0.0.0/0"]

  validation {
    condition     = alltrue([for network in var.nodes_from : can(cidrhost(network, 0))])
    error_message = "nodes_from are networks such as \"192.0.2.0/24\"."
  }
}

variable "echo_port" {
  description = "UDP port of the nodes' echo, as the module `node` has it."
  type        = number
  default     = 8600
}

variable "session_ports" {
  description = "First and last UDP port of sessions, as the module `node` has them."
  type        = object({ first = number, last = number })
  default     = { first = 20000, last = 20099 }

  validation {
    condition     = var.session_ports.first >= 1024 && var.session_ports.first <= var.session_ports.last && var.session_ports.last <= 65535
    error_message = "session_ports have 1024 <= first <= last <= 65535."
  }
  validation {
    condition     = var.echo_port < var.session_ports.first || var.echo_port > var.session_ports.last
    error_message = "session_ports contain echo_port, where the echo answers."
  }
}

variable "robots_from" {
  description = "Networks in which robots are: they reach the API, the echoes and the sessions. Nobody else does."
  type        = list(string)
  default     = ["0.0.0.0/0"]

  validation {
    condition     = length(var.robots_from) > 0 && alltrue([for network in var.robots_from : can(cidrhost(network, 0))])
    error_message = "robots_from are networks such as \"192.0.2.0/24\", one at least."
  }
}

variable "ssh_from" {
  description = "Networks from which SSH is let in. None: it is closed."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for network in var.ssh_from : can(cidrhost(network, 0)) && !endswith(network, "/0")])
    error_message = "ssh_from are networks such as \"192.0.2.0/24\", and not all addresses."
  }
}
