# Machines that are there already, bare, reached by SSH: no cloud, and no provider to download.

module "node" {
  source   = "../../modules/node"
  for_each = var.machines

  name          = each.key
  orchestrator  = var.orchestrator
  session_ports = var.session_ports
  advertise     = coalesce(each.value.advertise, each.value.address)
  ssh_from      = var.ssh_from
  package       = var.package
  images        = var.images
}

locals {
  ssh = {
    for name, machine in var.machines : name =>
    concat(["ssh"], var.ssh_options, ["-p", tostring(machine.port), "${machine.user}@${machine.address}"])
  }
}

resource "terraform_data" "setup" {
  for_each = var.machines

  # Another setup is brought to the same machine, which stays a site meanwhile.
  triggers_replace = [join(" ", local.ssh[each.key]), sha256(module.node[each.key].setup)]

  provisioner "local-exec" {
    interpreter = concat(["sh", "${path.module}/files/setup.sh"], local.ssh[each.key])
    command     = "sudo sh"
    environment = { SETUP = module.node[each.key].setup, MINUTES = var.wait_minutes }
  }
}

module "site" {
  source   = "../../modules/site"
  for_each = var.machines

  name         = each.key
  machine      = "${each.value.address}:${each.value.port}"
  tier         = "edge"
  cli          = var.cli
  deliver      = concat(local.ssh[each.key], ["sudo", "skytether-join"])
  wait_minutes = var.wait_minutes
  depends_on   = [terraform_data.setup]
}
