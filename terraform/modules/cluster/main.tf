# k3s over machines that are reached by SSH, and the chart on it. Tokens of the cluster are made when a node joins, are good
# for a quarter of an hour, and go through a pipe from machine to machine; the kubeconfig stays on the server, and Helm uses
# it through SSH. So the state has neither.

locals {
  ssh     = join(" ", [for word in concat(["ssh"], var.ssh_options, ["-l", var.ssh_user]) : "'${replace(word, "'", "'\\''")}'"])
  chart   = "${path.module}/../../../helm/skytether"
  sources = sort(fileset(local.chart, "**"))
  install = {
    SSH          = local.ssh
    VERSION      = var.k3s.version
    MIRROR       = var.k3s.mirror
    SHA256_AMD64 = lookup(var.k3s.sha256, "amd64", "")
    SHA256_ARM64 = lookup(var.k3s.sha256, "arm64", "")
    WAIT_MINUTES = var.wait_minutes
  }
}

resource "terraform_data" "server" {
  triggers_replace = [var.server.address]
  input            = { version = var.k3s.version }

  provisioner "local-exec" {
    command = "sh '${path.module}/files/k3s.sh' server"
    environment = merge(local.install, {
      ADDRESS  = var.server.address
      INTERNAL = coalesce(var.server.internal, var.server.address)
      PORTS    = "${var.session_ports.first}-${var.session_ports.last}"
    })
  }
}

resource "terraform_data" "agent" {
  for_each = var.agents

  triggers_replace = [terraform_data.server.id, each.value.address]
  input = {
    ssh    = local.ssh
    server = var.server.address
    name   = each.key
    # A node that is destroyed moves its pods elsewhere first.
    wait_minutes = var.wait_minutes
  }

  provisioner "local-exec" {
    command = "sh '${path.module}/files/k3s.sh' agent"
    environment = merge(local.install, {
      NAME     = each.key
      ADDRESS  = each.value.address
      INTERNAL = coalesce(each.value.internal, each.value.address)
      SERVER   = var.server.address
      JOIN     = coalesce(var.server.internal, var.server.address)
    })
  }

  provisioner "local-exec" {
    when    = destroy
    command = "sh '${path.module}/files/k3s.sh' leave"
    environment = {
      SSH          = self.output.ssh
      SERVER       = self.output.server
      NAME         = self.output.name
      WAIT_MINUTES = self.output.wait_minutes
    }
  }
}

# Newer k3s on the same machines, one after the other: pods run on meanwhile.
resource "terraform_data" "upgrade" {
  triggers_replace = [var.k3s.version]
  depends_on       = [terraform_data.server, terraform_data.agent]

  provisioner "local-exec" {
    command     = "sh '${path.module}/files/k3s.sh' upgrade"
    environment = merge(local.install, { MACHINES = join(" ", concat([var.server.address], [for agent in var.agents : agent.address])) })
  }
}

resource "terraform_data" "chart" {
  input = {
    ssh       = local.ssh
    server    = var.server.address
    name      = var.release.name
    namespace = var.release.namespace
  }
  triggers_replace = [terraform_data.server.id, var.release]
  depends_on       = [terraform_data.agent, terraform_data.upgrade]

  provisioner "local-exec" {
    when    = destroy
    command = "sh '${path.module}/files/chart.sh' uninstall"
    environment = {
      SSH          = self.output.ssh
      SERVER       = self.output.server
      RELEASE      = self.output.name
      NAMESPACE    = self.output.namespace
      WAIT_MINUTES = 10
    }
  }
}

# Apart from what uninstalls it, so that other values are an upgrade.
resource "terraform_data" "values" {
  triggers_replace = [
    terraform_data.chart.id,
    var.values,
    sha256(join("\n", [for name in local.sources : "${name} ${filesha256("${local.chart}/${name}")}"])),
  ]

  provisioner "local-exec" {
    command = "sh '${path.module}/files/chart.sh' install"
    environment = {
      SSH          = local.ssh
      SERVER       = var.server.address
      RELEASE      = var.release.name
      NAMESPACE    = var.release.namespace
      CHART        = local.chart
      VALUES       = join(" ", [for document in var.values : base64encode(document)])
      WAIT_MINUTES = var.wait_minutes
    }
  }
}
