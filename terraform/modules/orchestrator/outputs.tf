output "user_data" {
  description = "cloud-init's user-data for the orchestrator's machine. No secret is in it."
  value       = module.machine.user_data
}

output "setup" {
  description = "The same as a script for a machine that runs already."
  value       = module.machine.setup
}

output "url" {
  description = "URL of the API, for robots and operators."
  value       = "https://${local.host}:${var.port}"
}

output "nodes_url" {
  description = "URL at which nodes call: for the module `node`."
  value       = "https://${local.host}:${var.nodes_port}"
}

output "cli" {
  description = "Words that run `skytether` as operator on the machine: for the module `site`."
  value       = concat(local.ssh, ["sudo", "-u", "skytether", "env", "XDG_STATE_HOME=/var/lib", "SKYTETHER_CA_FILE=${local.tls.certificate}", "/opt/skytether/bin/skytether"])
}

output "next" {
  description = "The commands that give the first robot its token, and fetch the certificate that it trusts."
  value = join("\n", concat(
    ["${join(" ", local.ssh)} sudo -u skytether env XDG_STATE_HOME=/var/lib SKYTETHER_CA_FILE=${local.tls.certificate} /opt/skytether/bin/skytether robot add walker"],
    var.certificate == null ? ["${join(" ", local.ssh)} sudo cat ${local.tls.certificate} > orchestrator.pem   # SKYTETHER_CA_FILE=orchestrator.pem"] : [],
  ))
}
