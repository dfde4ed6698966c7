# A machine is a site from when it is made until it is destroyed. Both are commands, for a token that is good for one use
# and some minutes belongs into no state: it goes through a pipe from the orchestrator to the machine.

locals {
  quote = { for name, words in { cli = var.cli, deliver = var.deliver, forget = var.forget } : name =>
    join(" ", [for word in words : "'${replace(word, "'", "'\\''")}'"])
  }
}

resource "terraform_data" "site" {
  # What `destroy` needs to know; it is all that the state holds, and none of it is secret.
  input = {
    name          = var.name
    cli           = local.quote.cli
    drain_minutes = var.drain_minutes
  }
  triggers_replace = [var.machine, var.name]

  provisioner "local-exec" {
    command = "sh '${path.module}/files/site.sh' join"
    environment = {
      NAME         = var.name
      CLI          = local.quote.cli
      TIER         = var.tier
      VALID        = var.valid
      DELIVER      = local.quote.deliver
      FORGET       = local.quote.forget
      WAIT_MINUTES = var.wait_minutes
    }
  }

  provisioner "local-exec" {
    when    = destroy
    command = "sh '${path.module}/files/site.sh' leave"
    environment = {
      NAME         = self.output.name
      CLI          = self.output.cli
      WAIT_MINUTES = self.output.drain_minutes
    }
  }
}
