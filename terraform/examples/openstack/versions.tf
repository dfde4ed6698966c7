terraform {
  required_version = ">= 1.9"

  required_providers {
    openstack = {
      source  = "terraform-provider-openstack/openstack"
      version = ">= 3.0, < 4.0"
    }
  }
}

# Who and where, from clouds.yaml or the variables OS_*: no password is in these files or in the state.
provider "openstack" {
  cloud  = var.cloud
  region = var.region
}
