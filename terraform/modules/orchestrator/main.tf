# An orchestrator on a machine of its own. Its secrets (secret.key, operator.token, the key of its certificate) are made on
# the machine and stay there: Terraform never sees them. Whoever makes sites runs `skytether` on the machine, by SSH.

locals {
  names = distinct(concat([var.address], var.more_names))
  made  = "/etc/skytether/tls"
  tls   = var.certificate != null ? var.certificate : { certificate = "${local.made}/certificate.pem", key = "${local.made}/key.pem" }
  is_ip = { for name in local.names : name => can(regex("^[0-9.]+$|:", name)) }
  host  = strcontains(var.address, ":") ? "[${var.address}]" : var.address
  ssh   = concat(["ssh"], var.ssh_options, ["${var.ssh_user}@${var.address}"])
  everybody = tolist([
    for rule in [["tcp", var.port], ["udp", var.port], ["tcp", var.nodes_port]] :
    { protocol = rule[0], ports = tostring(rule[1]), from = tolist(["0.0.0.0/0", "::/0"]) }
  ])
  service = file("${path.module}/../../../docs/examples/orchestrator/skytether-orchestrator.service")
}

module "machine" {
  source = "../node"

  name      = var.name
  engine    = false
  open      = coalesce(var.open, local.everybody)
  ssh_from  = var.ssh_from
  ssh_keys  = var.ssh_keys
  package   = var.package
  packages  = concat(["openssh-client"], var.certificate == null ? ["openssl"] : [])
  reboot_at = var.reboot_at

  files = {
    "/etc/skytether/orchestrator.yaml" = {
      content = yamlencode(merge(yamldecode(var.settings), {
        host       = "::"
        port       = var.port
        hosts      = local.names
        local_site = false
        nodes      = { port = var.nodes_port }
        tls        = local.tls
      }))
    }
    "/etc/systemd/system/skytether-orchestrator.service" = { content = local.service }
    "/etc/systemd/system/skytether-orchestrator.service.d/environment.conf" = {
      content = "[Service]\nEnvironmentFile=-/etc/skytether/orchestrator.env\n"
    }
    "/usr/local/sbin/skytether-certificate" = {
      mode = "0755"
      content = templatefile("${path.module}/templates/certificate.sh.tftpl", {
        folder = local.made
        name   = var.address
        names  = join(",", [for name in local.names : "${local.is_ip[name] ? "IP" : "DNS"}:${name}"])
      })
    }
  }
  commands = concat(
    ["id skytether >/dev/null 2>&1 || useradd --system --home-dir /var/lib/skytether --shell /usr/sbin/nologin skytether"],
    var.certificate == null ? ["/usr/local/sbin/skytether-certificate"] : [],
    ["systemctl daemon-reload", "systemctl enable --quiet --now skytether-orchestrator.service"],
  )
}
