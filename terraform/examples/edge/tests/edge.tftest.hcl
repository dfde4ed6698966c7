variables {
  orchestrator = "https://cloud.example.org:8600"
  ssh_from     = ["192.0.2.0/24"]
  machines     = { ward-3 = { address = "192.0.2.73" }, kitchen = { address = "192.0.2.80", user = "admin", port = 2222, advertise = "203.0.113.9" } }
}

run "two_machines" {
  command = plan

  assert {
    condition     = strcontains(module.node["kitchen"].user_data, "--advertise 203.0.113.9") && strcontains(module.node["ward-3"].user_data, "--advertise 192.0.2.73")
    error_message = "robots are told each machine's address"
  }
  assert {
    condition     = endswith(join(" ", local.ssh["kitchen"]), " -p 2222 admin@192.0.2.80")
    error_message = "each machine is reached as it says"
  }
}

run "no_machines" {
  command = plan
  variables { machines = {} }
  expect_failures = [var.machines]
}

run "two_at_one_address" {
  command = plan
  variables { machines = { a = { address = "192.0.2.73" }, b = { address = "192.0.2.73" } } }
  expect_failures = [var.machines]
}

run "a_user_with_an_option" {
  command = plan
  variables { machines = { a = { address = "192.0.2.73", user = "-oProxyCommand=x" } } }
  expect_failures = [var.machines]
}

run "a_port_beyond_all_ports" {
  command = plan
  variables { machines = { a = { address = "192.0.2.73", port = 70000 } } }
  expect_failures = [var.machines]
}

run "an_address_with_a_user" {
  command = plan
  variables { machines = { a = { address = "root@192.0.2.73" } } }
  expect_failures = [var.machines]
}

run "locked_out" {
  command = plan
  variables { ssh_from = [] }
  expect_failures = [var.ssh_from]
}
