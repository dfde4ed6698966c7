output "name" {
  description = "Name of the site, once it is one."
  value       = terraform_data.site.output.name
}

output "next" {
  description = "The command that shows the site."
  value       = "skytether site show ${terraform_data.site.output.name}"
}
