output "url" {
  description = "URL of the orchestrator."
  value       = module.cloud.url
}

output "sites" {
  description = "The sites, once they are ready."
  value       = module.cloud.sites
}

output "next" {
  description = "The commands that give the first robot its token, and fetch the certificate that it trusts."
  value       = module.cloud.next
}
