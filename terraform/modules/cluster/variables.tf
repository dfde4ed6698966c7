variable "server" {
  description = "The machine that runs the control plane: its address by SSH, and the one at which the agents reach it."
  type = object({
    address  = string
    internal = optional(string)
  })

  validation {
    condition     = alltrue([for address in compact([var.server.address, var.server.internal]) : can(regex("^[A-Za-z0-9.:-]+$", address))])
    error_message = "server.address and server.internal are host names or addresses, without a port."
  }
}

variable "agents" {
  description = "The other machines, by the names of their nodes."
  type = map(object({
    address  = string
    internal = optional(string)
  }))
  default = {}

  validation {
    condition     = alltrue([for name, agent in var.agents : can(regex("^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", name))])
    error_message = "agents: names are lower-case letters, digits and '-': they are names of nodes."
  }
  validation {
    condition     = alltrue([for agent in var.agents : alltrue([for address in compact([agent.address, agent.internal]) : can(regex("^[A-Za-z0-9.:-]+$", address))])])
    error_message = "agents: address and internal are host names or addresses, without a port."
  }
  validation {
    condition     = length(distinct(concat([var.server.address], [for agent in var.agents : agent.address]))) == length(var.agents) + 1
    error_message = "agents: two machines have one address."
  }
}

variable "ssh_user" {
  description = "User of the machines who may use sudo."
  type        = string
  default     = "debian"

  validation {
    condition     = can(regex("^[a-z_][a-z0-9_-]*$", var.ssh_user))
    error_message = "ssh_user is a user's name."
  }
}

variable "ssh_options" {
  description = "Options of ssh for all machines."
  type        = list(string)
  default     = ["-o", "StrictHostKeyChecking=accept-new", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10"]
}

variable "k3s" {
  description = "Version of k3s, and the SHA-256 of its program for each architecture (`amd64`, `arm64`). Without a digest the one that its publisher has beside it is believed. `mirror` is where releases are, if not at GitHub."
  type = object({
    version = optional(string, "v1.34.1+k3s1")
    sha256  = optional(map(string), {})
    mirror  = optional(string, "https://github.com/k3s-io/k3s/releases/download")
  })
  default = {}

  validation {
    condition     = can(regex("^v1\\.[0-9]+\\.[0-9]+\\+k3s[0-9]+$", var.k3s.version))
    error_message = "k3s.version is a release such as \"v1.34.1+k3s1\"."
  }
  validation {
    condition     = can(tonumber(split(".", var.k3s.version)[1])) && try(tonumber(split(".", var.k3s.version)[1]) >= 20, false)
    error_message = "k3s.version: the chart is for Kubernetes 1.20 and newer."
  }
  validation {
    condition     = alltrue([for kind, digest in var.k3s.sha256 : contains(["amd64", "arm64"], kind) && can(regex("^[0-9a-f]{64}$", digest))])
    error_message = "k3s.sha256: 64 hexadecimal digits, by amd64 or arm64."
  }
  validation {
    condition     = can(regex("^https://[^\\s'\"]+[^/]$", var.k3s.mirror))
    error_message = "k3s.mirror begins with https:// and does not end with a slash."
  }
}

variable "session_ports" {
  description = "First and last port of sessions with robots: the ports of nodes that Kubernetes gives out (`reach: nodeport`). As in the module `network`."
  type        = object({ first = number, last = number })
  default     = { first = 20000, last = 20099 }

  validation {
    condition     = var.session_ports.first >= 1024 && var.session_ports.first <= var.session_ports.last && var.session_ports.last <= 65535
    error_message = "session_ports have 1024 <= first <= last <= 65535."
  }
}

variable "release" {
  description = "Name of the chart's release, and its namespace."
  type        = object({ name = optional(string, "skytether"), namespace = optional(string, "skytether") })
  default     = {}

  validation {
    condition     = alltrue([for name in [var.release.name, var.release.namespace] : can(regex("^[a-z0-9]([a-z0-9-]{0,51}[a-z0-9])?$", name))])
    error_message = "release: name and namespace are lower-case letters, digits and '-', 53 at most."
  }
}

variable "values" {
  description = "Values of the chart (docs/helm-values.md), as YAML documents, later ones before earlier ones: what `images/build.py --push ... --digests images.yaml` wrote, and your own. They are in the state: secrets belong into a Secret of the cluster."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for document in var.values : can(keys(yamldecode(document)))])
    error_message = "values: each is a YAML document of keys and values; file(\"images.yaml\") reads one."
  }
}

variable "wait_minutes" {
  description = "How long machines may take to come up, and the chart to be ready."
  type        = number
  default     = 20

  validation {
    condition     = var.wait_minutes > 0 && var.wait_minutes <= 240
    error_message = "wait_minutes is more than 0 and at most 240."
  }
}
