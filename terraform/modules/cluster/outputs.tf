output "server" {
  description = "Address of the server, once the chart is installed."
  value       = var.server.address
  depends_on  = [terraform_data.values]
}

output "next" {
  description = "The command that gives the first robot its token."
  value = join(" ", [
    "ssh", "${var.ssh_user}@${var.server.address}", "sudo", "k3s", "kubectl", "-n", var.release.namespace, "exec",
    "deployment/${var.release.name == "skytether" ? "skytether" : "${var.release.name}-skytether"}-orchestrator", "-c", "orchestrator", "--", "skytether", "robot", "add", "walker",
  ])
  depends_on = [terraform_data.values]
}
