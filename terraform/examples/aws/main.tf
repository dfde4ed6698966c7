# An orchestrator and sites on AWS: the module `aws` in a region. Credentials are AWS's own (`aws sso login`, AWS_PROFILE).

module "cloud" {
  source = "../../modules/aws"

  region        = var.region
  orchestrator  = var.orchestrator
  sites         = var.sites
  robots_from   = var.robots_from
  ssh_from      = var.ssh_from
  ssh_key       = var.ssh_key
  session_ports = var.session_ports
  package       = var.package
}
