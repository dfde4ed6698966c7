output "url" {
  description = "URL of the orchestrator."
  value       = module.orchestrator.url
}

output "nodes_url" {
  description = "URL at which nodes call, those elsewhere, too."
  value       = module.orchestrator.nodes_url
}

output "cli" {
  description = "Words that run `skytether` as operator."
  value       = module.orchestrator.cli
}

output "sites" {
  description = "The sites, once they are ready."
  value       = [for site in module.site : site.name]
}

output "next" {
  description = "The commands that give the first robot its token, and fetch the certificate that it trusts."
  value       = module.orchestrator.next
}
