# The network as data: what a cloud's own firewall opens, and which subnets there are. Each provider's resources are made
# of it in the examples, so that all open the same, and no more than the machines' own firewalls do.

locals {
  # Room for sixteen zones, so that one more moves no other.
  subnets = { for index, zone in var.zones : zone => cidrsubnet(var.cidr, 4, index) }

  ssh = length(var.ssh_from) == 0 ? {} : {
    ssh = { protocol = "tcp", first = 22, last = 22, from = var.ssh_from, description = "SSH of the operators" }
  }
  orchestrator = merge(local.ssh, {
    api   = { protocol = "tcp", first = var.api_port, last = var.api_port, from = distinct(concat(var.robots_from, [var.cidr])), description = "API" }
    echo  = { protocol = "udp", first = var.api_port, last = var.api_port, from = var.robots_from, description = "echo" }
    nodes = { protocol = "tcp", first = var.nodes_port, last = var.nodes_port, from = distinct(concat(var.nodes_from, [var.cidr])), description = "nodes" }
  })
  node = merge(local.ssh, {
    echo     = { protocol = "udp", first = var.echo_port, last = var.echo_port, from = var.robots_from, description = "echo" }
    sessions = { protocol = "udp", first = var.session_ports.first, last = var.session_ports.last, from = var.robots_from, description = "sessions with robots" }
  })
  # Pods ask these two by addresses of their own, which no cloud's firewall sees but the machine's does.
  pods = "10.42.0.0/16"
  cluster = merge(local.node, {
    kubernetes = { protocol = "tcp", first = 6443, last = 6443, from = [var.cidr, local.pods], description = "API of Kubernetes, for nodes and pods" }
    kubelet    = { protocol = "tcp", first = 10250, last = 10250, from = [var.cidr, local.pods], description = "kubelet" }
    wireguard  = { protocol = "udp", first = 51820, last = 51820, from = [var.cidr], description = "network of pods, encrypted" }
  })
}
