variables {
  name    = "ward-3"
  machine = "192.0.2.7"
  deliver = ["ssh", "debian@192.0.2.7", "sudo", "skytether-join"]
}

run "a_name_that_is_no_host_name" {
  command = plan
  variables { name = "-ward" }
  expect_failures = [var.name]
}

run "no_machine" {
  command = plan
  variables { machine = "" }
  expect_failures = [var.machine]
}

run "a_site_on_the_robot" {
  command = plan
  variables { tier = "robot" }
  expect_failures = [var.tier]
}

run "no_command" {
  command = plan
  variables { cli = [] }
  expect_failures = [var.cli]
}

run "no_way_to_the_machine" {
  command = plan
  variables { deliver = [] }
  expect_failures = [var.deliver]
}

run "a_time_without_a_unit" {
  command = plan
  variables { valid = "60" }
  expect_failures = [var.valid]
}

run "no_time_to_wait" {
  command = plan
  variables { wait_minutes = 0 }
  expect_failures = [var.wait_minutes]
}

run "no_time_to_drain" {
  command = plan
  variables { drain_minutes = 1000 }
  expect_failures = [var.drain_minutes]
}
