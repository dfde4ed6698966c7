# A cloud of one machine: this one, which runs a virtual machine. Everything else is what a user has: the module `node` renders
# the user-data, the module `site` makes the machine a site, and takes it out again before it is destroyed.

terraform {
  required_version = ">= 1.9"
}

variable "folder" {
  description = "Where disk, kernel and key are, and what the machine writes."
  type        = string
}

variable "cli" {
  description = "Words that run `skytether` as operator."
  type        = list(string)
}

variable "wheel" {
  description = "Name of Skytether's wheel."
  type        = string
}

variable "tap" {
  description = "Network device of the virtual machine."
  type        = string
}

module "node" {
  source = "../../terraform/modules/node"

  name         = "ward-vm"
  orchestrator = "https://10.86.9.1"
  ssh_from     = ["10.86.9.1/32"]
  ssh_keys     = [trimspace(file("${var.folder}/key.pub"))]
  package      = { source = "/opt/wheels/${var.wheel}", options = ["--no-index", "--find-links=/opt/wheels", "--no-compile"] }
  images       = ["/opt/images.tar"]
}

resource "terraform_data" "machine" {
  triggers_replace = [sha256(module.node.user_data)]
  input            = { folder = var.folder }

  provisioner "local-exec" {
    command     = "bash '${path.module}/machine.sh' start"
    environment = { FOLDER = var.folder, TAP = var.tap, USER_DATA = module.node.user_data }
  }

  provisioner "local-exec" {
    when        = destroy
    command     = "bash '${path.module}/machine.sh' stop"
    environment = { FOLDER = self.output.folder }
  }
}

module "site" {
  source = "../../terraform/modules/site"

  name    = module.node.name
  machine = terraform_data.machine.id
  cli     = var.cli
  deliver = [
    "ssh", "-i", "${var.folder}/key", "-o", "UserKnownHostsFile=${var.folder}/known_hosts", "-o", "StrictHostKeyChecking=accept-new",
    "-o", "BatchMode=yes", "-o", "ConnectTimeout=5", "debian@10.86.9.2", "sudo", "skytether-join",
  ]
  wait_minutes  = 20
  drain_minutes = 5
}

output "next" {
  description = "The command that shows the site."
  value       = module.site.next
}
