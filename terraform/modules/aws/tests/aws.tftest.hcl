# With a provider that is made up (mock_provider): the real one says what resources are made of, and nothing is asked.

mock_provider "aws" {
  mock_data "aws_ec2_instance_type_offerings" {
    defaults = { locations = ["eu-central-1a"] }
  }
  mock_data "aws_ami" {
    defaults = { id = "ami-0123456789abcdef0" }
  }
  mock_data "aws_caller_identity" {
    defaults = { account_id = "123456789012" }
  }
  mock_resource "aws_eip" {
    defaults = { public_ip = "203.0.113.7", public_dns = "ec2-203-0-113-7.example.com" }
  }
}

variables {
  region   = "eu-central-1"
  ssh_from = ["192.0.2.0/24"]
  ssh_key  = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJlbGlldmVtZWl0aXNub3RhcmVhbGtleWF0YWxsISEh me"
  package  = { source = "/opt/skytether-0.1.0-py3-none-any.whl[orchestrator,docker]" }
  sites    = { one = {} }
}

run "an_orchestrator_and_a_site" {
  command = plan

  assert {
    condition     = keys(aws_instance.node) == ["one"] && aws_instance.node["one"].metadata_options[0].http_tokens == "required"
    error_message = "one node, whose identity no container gets"
  }
  assert {
    condition     = keys(aws_vpc_security_group_ingress_rule.node) == ["echo 0.0.0.0/0", "sessions 0.0.0.0/0"]
    error_message = "robots' sessions and echoes are let in to a node, and nothing else"
  }
  assert {
    condition     = alltrue([for rule in values(aws_vpc_security_group_ingress_rule.orchestrator) : contains([8600, 8603], rule.from_port) || rule.cidr_ipv4 == "192.0.2.0/24"])
    error_message = "the orchestrator's API is open, and SSH to its operators"
  }
}

run "a_zone_without_that_machine_type" {
  command = plan
  variables { sites = { one = { zone = "c" } } }
  expect_failures = [aws_instance.node["one"]]
}

run "an_orchestrator_where_there_is_no_such_machine" {
  command = plan
  variables { orchestrator = { zone = "b" } }
  expect_failures = [aws_instance.orchestrator]
}

run "a_zone_for_a_region" {
  command = plan
  variables { region = "eu-central-1a" }
  expect_failures = [var.region]
}

run "a_disk_too_small" {
  command = plan
  variables { sites = { one = { disk = 8 } } }
  expect_failures = [var.sites]
}

run "a_name_that_no_site_has" {
  command = plan
  variables { sites = { "Site 1" = {} } }
  expect_failures = [var.sites]
}
