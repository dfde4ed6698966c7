# With a provider that is made up (mock_provider): the real one says what resources are made of, and nothing is asked.

mock_provider "google" {
  mock_data "google_compute_machine_types" {
    defaults = { machine_types = [{ name = "e2-small" }] }
  }
  mock_data "google_compute_image" {
    defaults = { self_link = "projects/debian-cloud/global/images/debian-12" }
  }
  mock_resource "google_compute_address" {
    defaults = { address = "203.0.113.7" }
  }
}

variables {
  project  = "robots-123456"
  region   = "europe-west4"
  ssh_from = ["192.0.2.0/24"]
  ssh_key  = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJlbGlldmVtZWl0aXNub3RhcmVhbGtleWF0YWxsISEh me"
  package  = { source = "/opt/skytether-0.1.0-py3-none-any.whl[orchestrator,docker]" }
  sites    = { one = {} }
}

run "an_orchestrator_and_a_site" {
  command = plan

  assert {
    condition     = keys(google_compute_instance.machine) == ["one", "orchestrator"]
    error_message = "two machines"
  }
  assert {
    condition     = keys(google_compute_firewall.let_in) == ["node-echo", "node-sessions", "orchestrator-api", "orchestrator-echo", "orchestrator-nodes", "orchestrator-ssh"]
    error_message = "API, echoes, sessions and the way for nodes are open, SSH to operators at the orchestrator, and nothing else"
  }
  assert {
    condition     = length(google_compute_instance.machine["orchestrator"].service_account) == 0
    error_message = "the orchestrator has no rights in the project"
  }
}

run "a_zone_without_that_machine_type" {
  command = plan
  override_data {
    target = data.google_compute_machine_types.here["one"]
    values = { machine_types = [] }
  }
  expect_failures = [google_compute_instance.machine["one"]]
}

run "a_zone_for_a_region" {
  command = plan
  variables { region = "europe-west4-a" }
  expect_failures = [var.region]
}

run "a_project_by_its_number" {
  command = plan
  variables { project = "123456789012" }
  expect_failures = [var.project]
}

run "a_site_of_the_orchestrators_name" {
  command = plan
  variables { sites = { orchestrator = {} } }
  expect_failures = [var.sites]
}

run "a_disk_too_small" {
  command = plan
  variables { sites = { one = { disk = 8 } } }
  expect_failures = [var.sites]
}
