# The orchestrator in the cloud, sites in the cloud and at the edge: the module `aws` and the example `edge` together. Nodes at the edge
# may be behind NAT: they call the orchestrator, and are reached by SSH from where Terraform runs.

module "cloud" {
  source = "../../modules/aws"

  region        = var.region
  sites         = var.cloud_sites
  robots_from   = var.robots_from
  ssh_from      = var.ssh_from
  ssh_key       = var.ssh_key
  session_ports = var.session_ports
  package       = var.package
}

module "edge" {
  source = "../edge"

  orchestrator  = module.cloud.nodes_url
  cli           = module.cloud.cli
  machines      = var.edge_machines
  ssh_from      = var.edge_ssh_from
  session_ports = var.session_ports
  package       = var.package
}
