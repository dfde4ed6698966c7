# With a provider that is made up (mock_provider): the real one says what resources are made of, and nothing is asked.

mock_provider "openstack" {
  mock_data "openstack_compute_flavor_v2" {
    defaults = { ram = 4096 }
  }
  mock_resource "openstack_networking_floatingip_v2" {
    defaults = { address = "203.0.113.7" }
  }
  mock_resource "openstack_networking_port_v2" {
    defaults = { all_fixed_ips = ["10.86.0.7"] }
  }
}

variables {
  external_network = "public"
  ssh_from         = ["192.0.2.0/24"]
  ssh_key          = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJlbGlldmVtZWl0aXNub3RhcmVhbGtleWF0YWxsISEh me"
  package          = { source = "/opt/skytether-0.1.0-py3-none-any.whl[orchestrator,docker]" }
  sites            = { one = {}, two = { floating = false } }
}

run "an_orchestrator_and_two_sites" {
  command = plan

  assert {
    condition     = keys(openstack_networking_floatingip_v2.machine) == ["one", "orchestrator"]
    error_message = "who is reached from outside has a floating address"
  }
  assert {
    condition     = alltrue([for name, rule in openstack_networking_secgroup_rule_v2.let_in : rule.remote_ip_prefix == "10.86.0.0/16" if startswith(name, "node ssh")])
    error_message = "SSH is let in to nodes from the private network alone"
  }
}

run "a_flavour_too_small" {
  command = plan
  override_data {
    target = data.openstack_compute_flavor_v2.machine["one"]
    values = { ram = 512 }
  }
  expect_failures = [data.openstack_compute_flavor_v2.machine["one"]]
}

run "a_site_of_the_orchestrators_name" {
  command = plan
  variables { sites = { orchestrator = {} } }
  expect_failures = [var.sites]
}

run "locked_out" {
  command = plan
  variables { ssh_from = [] }
  expect_failures = [var.ssh_from]
}
