variables {
  address = "cloud.example.org"
}

run "an_orchestrator" {
  variables {
    more_names = ["10.86.0.10"]
    ssh_from   = ["192.0.2.0/24"]
    settings   = "quotas: {robot_instances: 4}"
  }

  assert {
    condition     = output.url == "https://cloud.example.org:8600" && output.nodes_url == "https://cloud.example.org:8603"
    error_message = "the URL is shown"
  }
  assert {
    condition = jsonencode(yamldecode(one([
      for file in yamldecode(output.user_data).write_files : file.content if file.path == "/etc/skytether/orchestrator.yaml"
      ]))) == jsonencode({
      host = "::", hosts = ["cloud.example.org", "10.86.0.10"], local_site = false, nodes = { port = 8603 }, port = 8600, quotas = { robot_instances = 4 }
      tls  = { certificate = "/etc/skytether/tls/certificate.pem", key = "/etc/skytether/tls/key.pem" }
    })
    error_message = "the orchestrator is told its names, its certificate and the settings"
  }
  assert {
    condition     = strcontains(output.user_data, "subjectAltName=DNS:cloud.example.org,IP:10.86.0.10")
    error_message = "its certificate is for all its names"
  }
  assert {
    condition     = !strcontains(output.user_data, "docker.io") && strcontains(output.user_data, "tcp dport 8600 accept") && strcontains(output.user_data, "tcp dport 8603 accept")
    error_message = "it runs no services, and serves the API"
  }
  assert {
    condition     = strcontains(output.next, "robot add walker") && strcontains(output.next, "certificate.pem")
    error_message = "the next commands are shown"
  }
}

run "with_a_certificate_of_ones_own" {
  variables {
    certificate = { certificate = "/etc/letsencrypt/live/cloud/fullchain.pem", key = "/etc/letsencrypt/live/cloud/privkey.pem" }
  }

  assert {
    condition     = strcontains(output.user_data, "/etc/letsencrypt/live/cloud/privkey.pem") && !strcontains(output.user_data, "\n    /usr/local/sbin/skytether-certificate\n")
    error_message = "none is made where there is one"
  }
}

run "an_address_that_is_a_url" {
  command = plan
  variables { address = "https://cloud.example.org" }
  expect_failures = [var.address]
}

run "a_port_of_roots" {
  command = plan
  variables { port = 443 }
  expect_failures = [var.port]
}

run "one_port_twice" {
  command = plan
  variables { nodes_port = 8600 }
  expect_failures = [var.nodes_port]
}

run "a_password_for_the_state" {
  command = plan
  variables { settings = "database_url: postgresql://skytether:secret@db/skytether" }
  expect_failures = [var.settings]
}

run "settings_that_are_no_keys" {
  command = plan
  variables { settings = "- a" }
  expect_failures = [var.settings]
}

run "a_certificate_by_a_relative_path" {
  command = plan
  variables { certificate = { certificate = "a.pem", key = "b.pem" } }
  expect_failures = [var.certificate]
}

run "a_user_that_is_two_words" {
  command = plan
  variables { ssh_user = "debian -v" }
  expect_failures = [var.ssh_user]
}
