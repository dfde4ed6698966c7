# An orchestrator and sites on a private OpenStack. It has no store of secrets that every installation offers, so the join token
# is brought by SSH, through the orchestrator's machine; nodes let SSH in from the private network alone.

locals {
  machines = merge(
    { for name, site in var.sites : name => { flavor = site.flavor, zone = site.zone, kind = "node" } },
    { orchestrator = { flavor = var.orchestrator.flavor, zone = var.orchestrator.zone, kind = "orchestrator" } },
  )
  floating = merge({ for name, site in var.sites : name => true if site.floating }, { orchestrator = true })
  inside   = { for name, port in openstack_networking_port_v2.machine : name => port.all_fixed_ips[0] }
}

module "network" {
  source = "../../modules/network"

  robots_from   = var.robots_from
  ssh_from      = var.ssh_from
  session_ports = var.session_ports
}

module "network_of_nodes" {
  source = "../../modules/network"

  robots_from   = var.robots_from
  ssh_from      = ["10.86.0.0/16"]
  session_ports = var.session_ports
}

module "orchestrator" {
  source = "../../modules/orchestrator"

  address    = openstack_networking_floatingip_v2.machine["orchestrator"].address
  more_names = [local.inside["orchestrator"]]
  ssh_from   = var.ssh_from
  ssh_keys   = [var.ssh_key]
  package    = var.package
  open       = module.network.open.orchestrator
}

module "node" {
  source   = "../../modules/node"
  for_each = var.sites

  name          = each.key
  orchestrator  = "https://${local.inside["orchestrator"]}:8603"
  session_ports = var.session_ports
  advertise     = each.value.floating ? openstack_networking_floatingip_v2.machine[each.key].address : local.inside[each.key]
  ssh_from      = ["10.86.0.0/16"]
  ssh_keys      = [var.ssh_key]
  package       = var.package
}

module "site" {
  source   = "../../modules/site"
  for_each = var.sites

  name    = each.key
  machine = openstack_compute_instance_v2.machine[each.key].id
  tier    = "cloud"
  cli     = module.orchestrator.cli
  deliver = [
    "ssh", "-o", "StrictHostKeyChecking=accept-new", "-o", "BatchMode=yes", "-o", "ConnectTimeout=10",
    "-J", "debian@${openstack_networking_floatingip_v2.machine["orchestrator"].address}", "debian@${local.inside[each.key]}", "sudo", "skytether-join",
  ]

  depends_on = [openstack_networking_floatingip_associate_v2.machine, openstack_networking_secgroup_rule_v2.let_in, openstack_compute_instance_v2.machine]
}

# Both fail with the name that was asked for, where region or cloud have no such image or flavour.
data "openstack_images_image_v2" "debian" {
  name        = var.image
  most_recent = true
}

data "openstack_compute_flavor_v2" "machine" {
  for_each = local.machines

  name = each.value.flavor

  lifecycle {
    postcondition {
      condition     = self.ram >= 1024
      error_message = "flavour ${each.value.flavor} (${each.key}) has ${self.ram} MiB of memory: 1024 at least."
    }
  }
}

resource "openstack_compute_keypair_v2" "operator" {
  name       = "skytether"
  public_key = var.ssh_key
}

resource "openstack_compute_instance_v2" "machine" {
  for_each = local.machines

  name              = "skytether-${each.key}"
  flavor_id         = data.openstack_compute_flavor_v2.machine[each.key].id
  image_id          = data.openstack_images_image_v2.debian.id
  key_pair          = openstack_compute_keypair_v2.operator.name
  availability_zone = each.value.zone
  config_drive      = true # user-data without a metadata service that containers could ask
  user_data         = each.key == "orchestrator" ? module.orchestrator.user_data : module.node[each.key].user_data

  network {
    port = openstack_networking_port_v2.machine[each.key].id
  }

  lifecycle {
    ignore_changes = [image_id]
  }
}
