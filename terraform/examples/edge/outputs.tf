output "sites" {
  description = "The sites, once they are ready."
  value       = [for site in module.site : site.name]
}

output "next" {
  description = "The command that shows what robots can ask for now."
  value       = "skytether site list"
}
