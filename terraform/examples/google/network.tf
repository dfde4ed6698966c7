resource "google_compute_network" "this" {
  name                    = "skytether"
  auto_create_subnetworks = false
}

resource "google_compute_subnetwork" "this" {
  name                     = "skytether-${var.region}"
  network                  = google_compute_network.this.id
  ip_cidr_range            = module.network.subnets[var.region]
  private_ip_google_access = true

  log_config {
    flow_sampling = 0.1
  }
}

resource "google_compute_firewall" "let_in" {
  # Nodes have no SSH: their token comes another way.
  for_each = merge([
    for kind in ["orchestrator", "node"] : {
      for name, rule in module.network.rules[kind] : "${kind}-${name}" => merge(rule, { kind = kind }) if kind == "orchestrator" || name != "ssh"
    }
  ]...)

  name          = "skytether-${each.key}"
  description   = each.value.description
  network       = google_compute_network.this.id
  source_ranges = each.value.from
  target_tags   = ["skytether-${each.value.kind}"]

  allow {
    protocol = each.value.protocol
    ports    = [each.value.first == each.value.last ? tostring(each.value.first) : "${each.value.first}-${each.value.last}"]
  }
}

# Addresses stay when machines are made anew, and are known before: they are in certificate and user-data.
resource "google_compute_address" "machine" {
  for_each = local.machines

  name = "skytether-${each.key}"
}
