# An orchestrator and sites on Google Cloud. Nodes let nobody in but robots: each fetches its join token from the Secret
# Manager by its own service account, and calls the orchestrator.

locals {
  machines = merge(var.sites, { orchestrator = { machine_type = var.orchestrator.machine_type, zone = var.orchestrator.zone, disk = 20 } })
  kinds    = { for name in keys(local.machines) : name => name == "orchestrator" ? "orchestrator" : "node" }
  zones    = { for name, machine in local.machines : name => "${var.region}-${machine.zone}" }
  # Asks for a token of the machine's service account, and with it for the secret; both come and go through pipes.
  fetch = <<-END
    python3 - %s <<'PYTHON'
    import base64, json, sys, urllib.request
    def ask(url, **headers):
        return json.load(urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10))
    identity = ask("http://metadata.google.internal/computeMetadata/v1/instance/service-accounts/default/token", **{"Metadata-Flavor": "Google"})
    secret = ask(f"https://secretmanager.googleapis.com/v1/{sys.argv[1]}/versions/latest:access", Authorization="Bearer " + identity["access_token"])
    sys.stdout.buffer.write(base64.b64decode(secret["payload"]["data"]))
    PYTHON
  END
}

module "network" {
  source = "../../modules/network"

  zones         = [var.region] # a subnet of Google's is a region's
  robots_from   = var.robots_from
  ssh_from      = var.ssh_from
  session_ports = var.session_ports
}

module "orchestrator" {
  source = "../../modules/orchestrator"

  address  = google_compute_address.machine["orchestrator"].address
  ssh_user = "debian"
  ssh_from = var.ssh_from
  ssh_keys = [var.ssh_key]
  package  = var.package
  open     = module.network.open.orchestrator
}

module "node" {
  source   = "../../modules/node"
  for_each = var.sites

  name          = each.key
  orchestrator  = module.orchestrator.nodes_url
  session_ports = var.session_ports
  advertise     = google_compute_address.machine[each.key].address
  package       = var.package
  token_command = format(local.fetch, google_secret_manager_secret.join[each.key].id)
}

module "site" {
  source   = "../../modules/site"
  for_each = var.sites

  name    = each.key
  machine = google_compute_instance.machine[each.key].instance_id
  tier    = "cloud"
  cli     = module.orchestrator.cli
  deliver = ["gcloud", "--project", var.project, "--quiet", "secrets", "versions", "add", google_secret_manager_secret.join[each.key].secret_id, "--data-file=-"]

  depends_on = [google_compute_instance.machine, google_compute_firewall.let_in, google_secret_manager_secret_iam_member.node]
}

data "google_compute_image" "debian" {
  family  = "debian-12"
  project = "debian-cloud"
}

data "google_compute_machine_types" "here" {
  for_each = local.machines

  zone   = local.zones[each.key]
  filter = "name = \"${each.value.machine_type}\""
}

resource "google_compute_instance" "machine" {
  #checkov:skip=CKV_GCP_38:disks are encrypted by Google's own keys; a key of yours is one setting more
  #checkov:skip=CKV_GCP_40:robots reach their sessions at these addresses
  #checkov:skip=CKV_GCP_34:the operator's key comes by cloud-init, which OS Login would not take
  for_each = local.machines

  name         = "skytether-${each.key}"
  machine_type = each.value.machine_type
  zone         = local.zones[each.key]
  tags         = ["skytether-${local.kinds[each.key]}"]

  metadata = {
    user-data              = each.key == "orchestrator" ? module.orchestrator.user_data : module.node[each.key].user_data
    block-project-ssh-keys = "true"
    serial-port-enable     = "false"
    enable-oslogin         = "false" # cloud-init has the operator's key
  }

  boot_disk {
    initialize_params {
      image = data.google_compute_image.debian.self_link
      size  = each.value.disk
      type  = "pd-balanced"
    }
  }

  network_interface {
    subnetwork = google_compute_subnetwork.this.id
    access_config {
      nat_ip = google_compute_address.machine[each.key].address
    }
  }

  shielded_instance_config {
    enable_secure_boot          = true
    enable_vtpm                 = true
    enable_integrity_monitoring = true
  }

  # The orchestrator has no account: it needs nothing of the cloud.
  dynamic "service_account" {
    for_each = each.key == "orchestrator" ? [] : [google_service_account.node[each.key].email]
    content {
      email  = service_account.value
      scopes = ["https://www.googleapis.com/auth/cloud-platform"] # what it may is said by the roles below
    }
  }

  lifecycle {
    ignore_changes = [boot_disk[0].initialize_params[0].image]
    precondition {
      condition     = length(data.google_compute_machine_types.here[each.key].machine_types) > 0
      error_message = "${local.zones[each.key]} has no machines of type ${each.value.machine_type} (${each.key}): `gcloud compute machine-types list --zones ${local.zones[each.key]}` lists what there is."
    }
  }
}

# What a node may do in the project: read its own join token.
resource "google_service_account" "node" {
  for_each = var.sites

  account_id   = substr("sky-${substr(sha256(each.key), 0, 8)}-${each.key}", 0, 28)
  display_name = "Skytether site ${each.key}"
}

resource "google_secret_manager_secret" "join" {
  for_each = var.sites

  secret_id = "skytether-join-${each.key}"
  replication {
    auto {}
  }
}

resource "google_secret_manager_secret_iam_member" "node" {
  for_each = var.sites

  secret_id = google_secret_manager_secret.join[each.key].id
  role      = "roles/secretmanager.secretAccessor"
  member    = "serviceAccount:${google_service_account.node[each.key].email}"
}
