# What makes a bare Debian 12 machine a node. It is written once, as files and a script that may run again, and given
# out twice: as cloud-init's user-data, and as one script for a machine that runs already.

locals {
  any_v4 = "0.0.0.0/0"
  any_v6 = "::/0"

  rules = concat(
    [for rule in var.open : { protocol = rule.protocol, ports = rule.ports, from = rule.from }],
    length(var.ssh_from) == 0 ? [] : [{ protocol = "tcp", ports = "22", from = var.ssh_from }],
  )
  # nftables keeps the two kinds of addresses apart.
  accepts = flatten([
    for rule in local.rules : [
      [for from in [[for network in rule.from : network if !strcontains(network, ":")]] :
        "${contains(from, local.any_v4) ? "meta nfproto ipv4" : "ip saddr { ${join(", ", from)} }"} ${rule.protocol} dport ${rule.ports} accept"
      if length(from) > 0],
      [for from in [[for network in rule.from : network if strcontains(network, ":")]] :
        "${contains(from, local.any_v6) ? "meta nfproto ipv6" : "ip6 saddr { ${join(", ", from)} }"} ${rule.protocol} dport ${rule.ports} accept"
      if length(from) > 0],
    ]
  ])
  sites = var.orchestrator != null
  ports = "${var.session_ports.first}-${var.session_ports.last}"

  join_words = var.orchestrator == null ? [] : concat(
    ["site", "join", var.orchestrator, "--ports", local.ports, "--echo-port", tostring(coalesce(var.echo_port, 0))],
    var.advertise == null ? [] : ["--advertise", var.advertise],
    flatten([for device in var.devices : ["--device", device]]),
  )

  packages = distinct(concat(
    ["nftables", "unattended-upgrades", "ca-certificates"],
    var.package == null ? [] : ["python3", "python3-venv"],
    # Debian's kernel has AppArmor switched on, and an engine that cannot load its profile starts nothing: only recommended.
    var.engine ? ["docker.io", "apparmor"] : [],
    var.packages,
  ))

  files = merge(
    {
      "/etc/skytether/firewall.nft" = {
        mode = "0644"
        content = templatefile("${path.module}/templates/firewall.nft.tftpl", {
          ports   = local.ports
          accepts = local.accepts
          echo    = local.sites ? var.echo_port : null
          engine  = var.engine
        })
      }
      "/etc/systemd/system/skytether-firewall.service" = {
        mode    = "0644"
        content = file("${path.module}/files/skytether-firewall.service")
      }
      "/etc/apt/apt.conf.d/52skytether" = {
        mode    = "0644"
        content = templatefile("${path.module}/templates/upgrades.conf.tftpl", { reboot_at = var.reboot_at })
      }
      "/usr/local/sbin/skytether-setup" = {
        mode = "0755"
        content = templatefile("${path.module}/templates/setup.sh.tftpl", {
          packages = local.packages
          package  = var.package
          engine   = var.engine
          images   = var.images
          joins    = var.token_command != null
          commands = var.commands
        })
      }
    },
    var.engine ? {
      "/etc/docker/daemon.json" = { mode = "0644", content = file("${path.module}/files/daemon.json") }
    } : {},
    var.orchestrator == null ? {} : {
      "/usr/local/sbin/skytether-join" = {
        mode    = "0755"
        content = templatefile("${path.module}/templates/join.sh.tftpl", { words = local.join_words })
      }
    },
    var.token_command == null ? {} : {
      "/usr/local/sbin/skytether-token" = { mode = "0700", content = "#!/bin/sh\nset -eu\n${var.token_command}\n" }
      "/etc/systemd/system/skytether-join.service" = {
        mode    = "0644"
        content = file("${path.module}/files/skytether-join.service")
      }
    },
    var.files,
  )

  user_data = join("\n", ["#cloud-config", yamlencode({
    hostname            = var.name
    preserve_hostname   = false
    manage_etc_hosts    = true
    locale              = "C.UTF-8"
    ssh_pwauth          = false
    disable_root        = true
    ssh_authorized_keys = var.ssh_keys
    write_files = [
      for path, file in local.files : {
        path        = path
        permissions = file.mode
        content     = file.content
      }
    ]
    runcmd = [["/usr/local/sbin/skytether-setup"]]
  })])

  setup = templatefile("${path.module}/templates/by-ssh.sh.tftpl", {
    name  = var.name
    files = { for path, file in local.files : path => { mode = file.mode, content = base64encode(file.content) } }
  })
}
