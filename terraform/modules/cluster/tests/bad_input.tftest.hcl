variables {
  server = { address = "192.0.2.10" }
}

run "an_address_with_a_port" {
  command = plan
  variables { server = { address = "192.0.2.10/24" } }
  expect_failures = [var.server]
}

run "a_node_that_is_no_name" {
  command = plan
  variables { agents = { "Node 1" = { address = "192.0.2.11" } } }
  expect_failures = [var.agents]
}

run "one_machine_twice" {
  command = plan
  variables { agents = { one = { address = "192.0.2.10" } } }
  expect_failures = [var.agents]
}

run "a_version_that_is_no_release" {
  command = plan
  variables { k3s = { version = "latest" } }
  expect_failures = [var.k3s]
}

run "a_version_too_old_for_the_chart" {
  command = plan
  variables { k3s = { version = "v1.19.2+k3s1" } }
  expect_failures = [var.k3s]
}

run "a_digest_that_is_none" {
  command = plan
  variables { k3s = { sha256 = { amd64 = "abc" } } }
  expect_failures = [var.k3s]
}

run "a_mirror_over_plain_http" {
  command = plan
  variables { k3s = { mirror = "http://mirror.example" } }
  expect_failures = [var.k3s]
}

run "values_that_are_no_keys" {
  command = plan
  variables { values = ["images.yaml"] }
  expect_failures = [var.values]
}

run "a_release_in_capitals" {
  command = plan
  variables { release = { name = "Skytether" } }
  expect_failures = [var.release]
}

run "ports_the_wrong_way_round" {
  command = plan
  variables { session_ports = { first = 2000, last = 1999 } }
  expect_failures = [var.session_ports]
}

run "no_time_at_all" {
  command = plan
  variables { wait_minutes = 0 }
  expect_failures = [var.wait_minutes]
}

run "a_user_with_an_option" {
  command = plan
  variables { ssh_user = "-v" }
  expect_failures = [var.ssh_user]
}

run "what_is_planned" {
  command = plan
  variables {
    agents = { one = { address = "192.0.2.11" }, two = { address = "192.0.2.12", internal = "10.86.0.12" } }
  }

  assert {
    condition     = keys(terraform_data.agent) == ["one", "two"]
    error_message = "each agent is a node of its own"
  }
}
