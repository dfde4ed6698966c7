data "openstack_networking_network_v2" "external" {
  name     = var.external_network
  external = true
}

resource "openstack_networking_network_v2" "this" {
  name           = "skytether"
  admin_state_up = true
}

resource "openstack_networking_subnet_v2" "this" {
  name            = "skytether"
  network_id      = openstack_networking_network_v2.this.id
  cidr            = module.network.subnets["a"]
  ip_version      = 4
  dns_nameservers = var.nameservers
}

resource "openstack_networking_router_v2" "this" {
  name                = "skytether"
  external_network_id = data.openstack_networking_network_v2.external.id
}

resource "openstack_networking_router_interface_v2" "this" {
  router_id = openstack_networking_router_v2.this.id
  subnet_id = openstack_networking_subnet_v2.this.id
}

# Its default rules let out what a machine asks for, and nothing in.
resource "openstack_networking_secgroup_v2" "kind" {
  for_each = toset(["orchestrator", "node"])

  name        = "skytether-${each.key}"
  description = "Skytether: ${each.key}"
}

locals {
  rules = { orchestrator = module.network.rules.orchestrator, node = module.network_of_nodes.rules.node }
  let_in = merge(flatten([
    for kind, rules in local.rules : [
      for name, rule in rules : {
        for from in rule.from : "${kind} ${name} ${from}" => merge(rule, { kind = kind, from = from })
      }
    ]
  ])...)
}

resource "openstack_networking_secgroup_rule_v2" "let_in" {
  for_each = local.let_in

  security_group_id = openstack_networking_secgroup_v2.kind[each.value.kind].id
  description       = each.value.description
  direction         = "ingress"
  ethertype         = strcontains(each.value.from, ":") ? "IPv6" : "IPv4"
  protocol          = each.value.protocol
  port_range_min    = each.value.first
  port_range_max    = each.value.last
  remote_ip_prefix  = each.value.from
}

resource "openstack_networking_port_v2" "machine" {
  for_each = local.machines

  name               = "skytether-${each.key}"
  network_id         = openstack_networking_network_v2.this.id
  security_group_ids = [openstack_networking_secgroup_v2.kind[each.value.kind].id]

  fixed_ip {
    subnet_id = openstack_networking_subnet_v2.this.id
  }
}

resource "openstack_networking_floatingip_v2" "machine" {
  for_each = local.floating

  pool        = var.external_network
  description = "skytether-${each.key}"
}

resource "openstack_networking_floatingip_associate_v2" "machine" {
  for_each = local.floating

  floating_ip = openstack_networking_floatingip_v2.machine[each.key].address
  port_id     = openstack_networking_port_v2.machine[each.key].id
  depends_on  = [openstack_networking_router_interface_v2.this]
}
