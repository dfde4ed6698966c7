output "user_data" {
  description = "cloud-init's user-data, for any provider's machine of Debian 12. No secret is in it."
  value       = local.user_data

  precondition {
    condition     = length(base64gzip(local.user_data)) <= 16384
    error_message = "user_data is over 16 KiB, even packed, and clouds take no more: bring the larger of `files` in the image."
  }
}

output "setup" {
  description = "The same as one shell script, to be run as root on a machine that runs already (`ssh machine sudo sh < script`). It may be run again."
  value       = local.setup
}

output "name" {
  description = "Name of the machine, and of the site."
  value       = var.name
}

output "session_ports" {
  description = "The UDP ports of sessions, for the cloud's own firewall."
  value       = var.session_ports
}

output "next" {
  description = "The command that makes the machine a site, to be run where the orchestrator's operator works."
  value = var.orchestrator == null ? "nothing: the machine joins no orchestrator" : (
    var.token_command != null
    ? "put a token of `skytether site invite ${var.name} --valid 1h` where the machine's token_command finds it"
    : "skytether site invite ${var.name} --tier edge --valid 1h | ssh debian@${coalesce(var.advertise, var.name)} sudo skytether-join"
  )
}
