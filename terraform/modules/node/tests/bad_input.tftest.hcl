# Every variable that a person types wrongly is refused by its name, before anything is made.

variables {
  name = "ward-3"
}

run "a_name_that_is_no_host_name" {
  command = plan
  variables { name = "Ward 3" }
  expect_failures = [var.name]
}

run "an_orchestrator_over_plain_http" {
  command = plan
  variables { orchestrator = "http://cloud:8600" }
  expect_failures = [var.orchestrator]
}

run "an_orchestrator_with_a_path" {
  command = plan
  variables { orchestrator = "https://cloud:8600/api" }
  expect_failures = [var.orchestrator]
}

run "ports_the_wrong_way_round" {
  command = plan
  variables { session_ports = { first = 20099, last = 20000 } }
  expect_failures = [var.session_ports]
}

run "ports_of_the_system" {
  command = plan
  variables { session_ports = { first = 22, last = 1024 } }
  expect_failures = [var.session_ports]
}

run "a_port_and_a_half" {
  command = plan
  variables { session_ports = { first = 20000.5, last = 20099 } }
  expect_failures = [var.session_ports]
}

run "an_echo_among_the_sessions" {
  command = plan
  variables { echo_port = 20000 }
  expect_failures = [var.echo_port]
}

run "an_advertised_address_with_a_port" {
  command = plan
  variables { advertise = "192.0.2.7/32" }
  expect_failures = [var.advertise]
}

run "a_device_that_is_a_folder_of_the_system" {
  command = plan
  variables { devices = ["/etc"] }
  expect_failures = [var.devices]
}

run "a_site_without_an_engine" {
  command = plan
  variables {
    engine       = false
    orchestrator = "https://cloud:8600"
  }
  expect_failures = [var.engine]
}

run "an_unknown_protocol" {
  command = plan
  variables { open = [{ protocol = "sctp", ports = "1" }] }
  expect_failures = [var.open]
}

run "a_range_the_wrong_way_round" {
  command = plan
  variables { open = [{ protocol = "tcp", ports = "9000-8000" }] }
  expect_failures = [var.open]
}

run "a_port_beyond_all_ports" {
  command = plan
  variables { open = [{ protocol = "tcp", ports = "70000" }] }
  expect_failures = [var.open]
}

run "an_address_that_is_no_network" {
  command = plan
  variables { open = [{ protocol = "tcp", ports = "8600", from = ["192.0.2.7"] }] }
  expect_failures = [var.open]
}

run "a_rule_for_nobody" {
  command = plan
  variables { open = [{ protocol = "tcp", ports = "8600", from = [] }] }
  expect_failures = [var.open]
}

run "ssh_from_everywhere" {
  command = plan
  variables { ssh_from = ["0.0.0.0/0"] }
  expect_failures = [var.ssh_from]
}

run "a_private_key_where_a_public_one_belongs" {
  command = plan
  variables { ssh_keys = ["-----BEGIN OPENSSH PRIVATE KEY-----"] }
  expect_failures = [var.ssh_keys]
}

run "a_package_by_its_name_alone" {
  command = plan
  variables { package = { source = "skytether" } }
  expect_failures = [var.package]
}

run "a_package_without_its_digest" {
  command = plan
  variables { package = { source = "https://example.org/skytether-0.1.0-py3-none-any.whl" } }
  expect_failures = [var.package]
}

run "an_option_of_pip_that_is_two_words" {
  command = plan
  variables { package = { source = "/opt/skytether.whl", options = ["--no-index; reboot"] } }
  expect_failures = [var.package]
}

run "images_by_a_relative_path" {
  command = plan
  variables { images = ["images.tar"] }
  expect_failures = [var.images]
}

run "a_time_that_no_clock_shows" {
  command = plan
  variables { reboot_at = "25:00" }
  expect_failures = [var.reboot_at]
}

run "a_token_for_nobody" {
  command = plan
  variables { token_command = "cat /run/token" }
  expect_failures = [var.token_command]
}

run "a_package_of_debian_with_an_option" {
  command = plan
  variables { packages = ["-o=x"] }
  expect_failures = [var.packages]
}

run "a_file_without_a_path" {
  command = plan
  variables { files = { "motd" = { content = "hello" } } }
  expect_failures = [var.files]
}

run "more_than_clouds_take" {
  command = plan
  variables {
    # Hexadecimal digits of hashes: what cannot be packed to less than half.
    files = { "/etc/large" = { content = join("", [for i in range(600) : sha512(tostring(i))]) } }
  }
  expect_failures = [output.user_data]
}
