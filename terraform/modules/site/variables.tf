variable "name" {
  description = "Name of the site; that of the module `node`."
  type        = string

  validation {
    condition     = can(regex("^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$", var.name))
    error_message = "name is lower-case letters, digits and '-' (63 at most, '-' neither first nor last)."
  }
}

variable "machine" {
  description = "What is another where the machine is another: its id, or its address. The site is drained and joined anew when it changes."
  type        = string

  validation {
    condition     = length(var.machine) > 0
    error_message = "machine is empty: give the machine's id or address, which also makes Terraform wait for it."
  }
}

variable "tier" {
  description = "Where the site is, seen from robots."
  type        = string
  default     = "edge"

  validation {
    condition     = contains(["edge", "cloud"], var.tier)
    error_message = "tier is \"edge\" or \"cloud\"."
  }
}

variable "cli" {
  description = "Words that run the command `skytether` as operator: here, or by SSH on the orchestrator's machine, whose operator token then never leaves it (module `orchestrator`, output `cli`)."
  type        = list(string)
  default     = ["skytether"]

  validation {
    condition     = length(var.cli) > 0
    error_message = "cli has one word at least, such as [\"skytether\"]."
  }
}

variable "deliver" {
  description = "Words of a command that takes the join token on its standard input and brings it to the machine: [\"ssh\", \"debian@192.0.2.7\", \"sudo\", \"skytether-join\"], or one that puts it into the cloud's store of secrets."
  type        = list(string)

  validation {
    condition     = length(var.deliver) > 0
    error_message = "deliver is a command, one word for each element: [\"ssh\", \"debian@192.0.2.7\", \"sudo\", \"skytether-join\"]."
  }
}

variable "forget" {
  description = "Words of a command that takes the token away from where `deliver` put it, once the machine has joined. Empty: there is nothing to take away."
  type        = list(string)
  default     = []
}

variable "valid" {
  description = "How long the join token may be used, once: as long as a machine needs to come up."
  type        = string
  default     = "1h"

  validation {
    condition     = can(regex("^[1-9][0-9]{0,3}(s|m|h)$", var.valid))
    error_message = "valid is a whole number with s, m or h, such as \"30m\"."
  }
}

variable "wait_minutes" {
  description = "How long the machine may take to come up and join."
  type        = number
  default     = 30

  validation {
    condition     = var.wait_minutes > 0 && var.wait_minutes <= 240
    error_message = "wait_minutes is more than 0 and at most 240."
  }
}

variable "drain_minutes" {
  description = "How long what runs at the site may take to move elsewhere before it is destroyed. After that `destroy` fails, and nothing is lost: end the instances or make room, and run it again."
  type        = number
  default     = 15

  validation {
    condition     = var.drain_minutes > 0 && var.drain_minutes <= 240
    error_message = "drain_minutes is more than 0 and at most 240."
  }
}
