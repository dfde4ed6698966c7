run "what_is_open" {
  variables {
    zones       = ["a", "b"]
    robots_from = ["192.0.2.0/24"]
    ssh_from    = ["198.51.100.7/32"]
  }

  assert {
    condition     = jsonencode(output.subnets) == jsonencode({ a = "10.86.0.0/20", b = "10.86.16.0/20" })
    error_message = "each zone has a subnet of its own"
  }
  assert {
    condition     = keys(output.rules.orchestrator) == ["api", "echo", "nodes", "ssh"] && keys(output.rules.node) == ["echo", "sessions", "ssh"]
    error_message = "API, echo, nodes and sessions are open, and nothing else"
  }
  assert {
    condition     = output.rules.orchestrator.api.from == tolist(["192.0.2.0/24", "10.86.0.0/16"])
    error_message = "robots and nodes reach the API"
  }
  assert {
    condition     = output.rules.node.sessions.first == 20000 && output.rules.node.sessions.last == 20099 && output.rules.node.sessions.protocol == "udp"
    error_message = "robots reach the sessions"
  }
  assert {
    condition     = alltrue([for name, rule in output.rules.cluster : rule.from[0] == "10.86.0.0/16" && alltrue([for from in rule.from : startswith(from, "10.")]) if contains(["kubernetes", "kubelet", "wireguard"], name)])
    error_message = "what nodes of a cluster say to each other stays among them"
  }
  assert {
    condition     = length(output.open.node) == 0 && length(output.open.orchestrator) == 3
    error_message = "the machines' own firewalls are told the same"
  }
}

run "without_ssh" {
  assert {
    condition     = alltrue([for rules in output.rules : !contains(keys(rules), "ssh")])
    error_message = "SSH is closed where nobody asked for it"
  }
}

run "no_network" {
  command = plan
  variables { cidr = "10.86.0.0" }
  expect_failures = [var.cidr]
}

run "an_address_in_a_network" {
  command = plan
  variables { cidr = "10.86.0.1/16" }
  expect_failures = [var.cidr]
}

run "a_network_too_small" {
  command = plan
  variables { cidr = "10.86.0.0/28" }
  expect_failures = [var.cidr]
}

run "one_zone_twice" {
  command = plan
  variables { zones = ["a", "a"] }
  expect_failures = [var.zones]
}

run "no_port" {
  command = plan
  variables { api_port = 0 }
  expect_failures = [var.api_port]
}

run "sessions_over_the_api" {
  command = plan
  variables { session_ports = { first = 8000, last = 9000 } }
  expect_failures = [var.session_ports]
}

run "two_uses_of_one_port" {
  command = plan
  variables { nodes_port = 8600 }
  expect_failures = [var.nodes_port]
}

run "nodes_at_an_address" {
  command = plan
  variables { nodes_from = ["192.0.2.7"] }
  expect_failures = [var.nodes_from]
}

run "no_robots" {
  command = plan
  variables { robots_from = [] }
  expect_failures = [var.robots_from]
}

run "ssh_from_everywhere" {
  command = plan
  variables { ssh_from = ["::/0"] }
  expect_failures = [var.ssh_from]
}
