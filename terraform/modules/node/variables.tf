variable "name" {
  description = "Name of the machine, and of the site that it becomes. `@SKYTETHER_NAME@` where a group makes machines (docs/groups.md)."
  type        = string

  validation {
    condition     = var.name == "@SKYTETHER_NAME@" || can(regex("^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", var.name))
    error_message = "name is lower-case letters, digits and '-' (63 at most, '-' neither first nor last), such as \"ward-3\": it is the host name and the site's name."
  }
}

variable "orchestrator" {
  description = "Where the orchestrator takes nodes: https://HOST, or https://HOST:PORT if that is not 8603 (`nodes.port`); `@SKYTETHER_URL@` for a group. Null: the machine joins nothing."
  type        = string
  default     = null

  validation {
    condition     = var.orchestrator == null || var.orchestrator == "@SKYTETHER_URL@" || can(regex("^https://[A-Za-z0-9.-]+(:[0-9]{1,5})?$|^https://\\[[0-9a-f:]+\\](:[0-9]{1,5})?$", var.orchestrator))
    error_message = "orchestrator is https://HOST or https://HOST:PORT, without a path: a join token is shown to nobody over plain HTTP."
  }
}

variable "session_ports" {
  description = "First and last UDP port of sessions with robots. One instance has one port; the firewall opens these and no others."
  type        = object({ first = number, last = number })
  default     = { first = 20000, last = 20099 }

  validation {
    condition = alltrue([
      floor(var.session_ports.first) == var.session_ports.first,
      floor(var.session_ports.last) == var.session_ports.last,
      var.session_ports.first >= 1024,
      var.session_ports.first <= var.session_ports.last,
      var.session_ports.last <= 65535,
    ])
    error_message = "session_ports are whole numbers with 1024 <= first <= last <= 65535, such as { first = 20000, last = 20099 }."
  }
}

variable "echo_port" {
  description = "UDP port of the echo by which robots measure their way to the site. Null: none."
  type        = number
  default     = 8600

  validation {
    condition     = var.echo_port == null || try(floor(var.echo_port) == var.echo_port && var.echo_port >= 1 && var.echo_port <= 65535 && (var.echo_port < var.session_ports.first || var.echo_port > var.session_ports.last), false)
    error_message = "echo_port is a whole number from 1 to 65535, and none of session_ports."
  }
}

variable "advertise" {
  description = "Address that robots are told, where it is not the machine's own: the public one of a cloud, or a router's. Null: what the machine finds."
  type        = string
  default     = null

  validation {
    condition     = var.advertise == null || can(regex("^[A-Za-z0-9.:-]+$", var.advertise))
    error_message = "advertise is one address or host name, without a port."
  }
}

variable "devices" {
  description = "Files of devices that services there may have, such as \"/dev/video0\": the machine refuses its orchestrator any other. The site's option `devices` names them, too."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for device in var.devices : can(regex("^/dev/[A-Za-z0-9._/-]+$", device))])
    error_message = "devices are paths such as \"/dev/video0\"."
  }
}

variable "engine" {
  description = "Install Debian's Docker engine, for services. It listens on the machine's own socket only: whoever needs it from elsewhere comes by SSH."
  type        = bool
  default     = true

  validation {
    condition     = var.engine || var.orchestrator == null
    error_message = "engine = false with an orchestrator: a machine without an engine runs no services and cannot be a site."
  }
}

variable "open" {
  description = "What the firewall opens besides the session ports: the API of an orchestrator, the ports among the nodes of a cluster. `ports` is one port or FIRST-LAST; `from` are networks."
  type = list(object({
    protocol = string
    ports    = string
    from     = optional(list(string), ["0.0.0.0/0", "::/0"])
  }))
  default = []

  validation {
    condition     = alltrue([for rule in var.open : contains(["tcp", "udp"], rule.protocol)])
    error_message = "open: protocol is \"tcp\" or \"udp\"."
  }
  validation {
    condition = alltrue([
      for rule in var.open : can(regex("^[0-9]{1,5}(-[0-9]{1,5})?$", rule.ports)) &&
      alltrue([for port in split("-", rule.ports) : try(tonumber(port) >= 1 && tonumber(port) <= 65535, false)]) &&
      try(tonumber(split("-", rule.ports)[0]) <= tonumber(reverse(split("-", rule.ports))[0]), false)
    ])
    error_message = "open: ports is one port from 1 to 65535, or FIRST-LAST with FIRST <= LAST, such as \"8600\"."
  }
  validation {
    condition     = alltrue(flatten([for rule in var.open : [for network in rule.from : can(cidrhost(network, 0))]]))
    error_message = "open: from are networks such as \"192.0.2.0/24\" or \"2001:db8::/32\"; one address is \"192.0.2.7/32\"."
  }
  validation {
    condition     = alltrue([for rule in var.open : length(rule.from) > 0])
    error_message = "open: from is empty: leave the rule out, or name the networks it is for."
  }
}

variable "ssh_from" {
  description = "Networks from which SSH is let in. None: SSH is closed."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for network in var.ssh_from : can(cidrhost(network, 0))])
    error_message = "ssh_from are networks such as \"192.0.2.0/24\"; one address is \"192.0.2.7/32\"."
  }
  validation {
    condition     = alltrue([for network in var.ssh_from : !endswith(network, "/0")])
    error_message = "ssh_from holds a network of all addresses: name those from which you work."
  }
}

variable "ssh_keys" {
  description = "Public SSH keys of the image's own user (`debian` on Debian's images). There is no password."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for key in var.ssh_keys : can(regex("^(ssh-ed25519|ssh-rsa|ecdsa-sha2-nistp(256|384|521)|sk-[a-z0-9@.-]+) [A-Za-z0-9+/=]+", key))])
    error_message = "ssh_keys are public keys, each a line as in id_ed25519.pub."
  }
}

variable "package" {
  description = "What pip installs on the machine, with its extras: the path of a wheel that the image has, or an https:// address with the wheel's #sha256=. `options` go to pip: `--no-index --find-links=/opt/wheels`, `--constraint=...`. Null: the image has `skytether` in /opt/skytether already."
  type = object({
    source  = string
    options = optional(list(string), [])
  })
  default = null

  validation {
    condition     = var.package == null || can(regex("^(/[^#'\"\\s]+\\.whl(\\[[a-z0-9,-]+\\])?|(skytether(\\[[a-z0-9,-]+\\])? @ )?https://[^#'\"\\s]+\\.whl#sha256=[0-9a-f]{64})$", var.package.source))
    error_message = "package.source is /PATH/NAME.whl[EXTRAS] or \"skytether[EXTRAS] @ https://HOST/NAME.whl#sha256=...\": a name alone would be whatever the package index has under it."
  }
  validation {
    condition     = var.package == null || alltrue([for option in try(var.package.options, []) : can(regex("^--[a-z-]+(=[^'\"\\s]*)?$", option))])
    error_message = "package.options are options of pip, each as one word: \"--find-links=/opt/wheels\"."
  }
}

variable "images" {
  description = "Archives of container images on the machine (`docker save`) that the engine is given, for a site that reaches no registry."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for path in var.images : can(regex("^/[A-Za-z0-9._/-]+$", path))])
    error_message = "images are absolute paths on the machine, such as \"/opt/images/services.tar\"."
  }
}

variable "reboot_at" {
  description = "Time of day (HH:MM, the machine's own) at which the machine restarts when a security update asks for it. Null: it never does by itself."
  type        = string
  default     = null

  validation {
    condition     = var.reboot_at == null || can(regex("^([01][0-9]|2[0-3]):[0-5][0-9]$", var.reboot_at))
    error_message = "reboot_at is a time of day such as \"03:30\"."
  }
}

variable "token_command" {
  description = "Command on the machine that prints its join token, for a machine that nobody reaches: from the cloud's store of secrets, by the machine's own identity; `echo @SKYTETHER_TOKEN@` for a group. It is tried every 10 s until the machine has joined. Null: the token is brought by SSH (module `site`)."
  type        = string
  default     = null

  validation {
    condition     = var.token_command == null || var.orchestrator != null
    error_message = "token_command without orchestrator: there is nothing to join."
  }
}

variable "packages" {
  description = "More packages of Debian."
  type        = list(string)
  default     = []

  validation {
    condition     = alltrue([for name in var.packages : can(regex("^[a-z0-9][a-z0-9+.-]+$", name))])
    error_message = "packages are names of Debian's packages."
  }
}

variable "files" {
  description = "More files, by absolute path: content and mode. They are in the user-data, and so in Terraform's state and for all on the machine to read: no secrets."
  type        = map(object({ content = string, mode = optional(string, "0644") }))
  default     = {}

  validation {
    condition     = alltrue([for path, file in var.files : can(regex("^/[A-Za-z0-9._/-]+$", path)) && can(regex("^0[0-7]{3}$", file.mode))])
    error_message = "files: each has an absolute path and a mode such as \"0644\"."
  }
}

variable "commands" {
  description = "More commands of the shell, after everything else; one that fails ends the set-up."
  type        = list(string)
  default     = []
}
