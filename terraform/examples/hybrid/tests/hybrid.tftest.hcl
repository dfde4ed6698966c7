mock_provider "aws" {
  mock_data "aws_ec2_instance_type_offerings" {
    defaults = { locations = ["eu-central-1a"] }
  }
  mock_data "aws_ami" {
    defaults = { id = "ami-0123456789abcdef0" }
  }
  mock_resource "aws_eip" {
    defaults = { public_ip = "203.0.113.7", public_dns = "ec2-203-0-113-7.example.com" }
  }
}

variables {
  region        = "eu-central-1"
  ssh_from      = ["192.0.2.0/24"]
  ssh_key       = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJlbGlldmVtZWl0aXNub3RhcmVhbGtleWF0YWxsISEh me"
  package       = { source = "/opt/skytether-0.1.0-py3-none-any.whl[orchestrator,docker]" }
  edge_machines = { ward-3 = { address = "10.0.0.73" } }
  edge_ssh_from = ["10.0.0.0/24"]
}

run "a_cloud_and_an_edge" {
  command = plan
}

run "one_name_twice" {
  command = plan
  variables { cloud_sites = { ward-3 = {} } }
  expect_failures = [var.edge_machines]
}
