output "subnets" {
  description = "Subnet of each zone."
  value       = local.subnets
}

output "rules" {
  description = "What is let in to an `orchestrator`, a `node`, a node of a `cluster`: by a name, protocol, first and last port, networks, and what it is for."
  value       = { orchestrator = local.orchestrator, node = local.node, cluster = local.cluster }
}

output "open" {
  description = "The same in the words of the module `node`'s `open`, without what it opens by itself (sessions, echo, SSH)."
  value = {
    for kind, rules in { orchestrator = local.orchestrator, node = local.node, cluster = local.cluster } : kind => [
      for name, rule in rules : {
        protocol = rule.protocol
        ports    = rule.first == rule.last ? tostring(rule.first) : "${rule.first}-${rule.last}"
        from     = rule.from
      } if name != "ssh" && (kind == "orchestrator" || !contains(["sessions", "echo"], name))
    ]
  }
}
