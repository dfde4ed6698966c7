# What the user-data says, and that it says no more.

variables {
  name = "ward-3"
}

run "a_machine_that_joins_nothing" {
  assert {
    condition     = startswith(output.user_data, "#cloud-config\n")
    error_message = "cloud-init takes user-data by its first line"
  }
  assert {
    condition     = !strcontains(output.user_data, "skytether-join")
    error_message = "without an orchestrator nothing joins"
  }
  assert {
    condition     = !strcontains(output.user_data, "dport 22 ")
    error_message = "SSH is closed where nobody asked for it"
  }
  assert {
    condition     = strcontains(output.user_data, "udp dport 20000-20099 accept")
    error_message = "the session ports are open"
  }
  assert {
    condition     = strcontains(output.user_data, "docker.io apparmor")
    error_message = "without AppArmor's parser no container starts on Debian's kernel"
  }
  assert {
    condition     = yamldecode(output.user_data).ssh_pwauth == false
    error_message = "no password opens the machine"
  }
}

run "a_site" {
  variables {
    orchestrator  = "https://cloud.example.org:8603"
    session_ports = { first = 30000, last = 30009 }
    advertise     = "203.0.113.7"
    devices       = ["/dev/video0"]
    ssh_from      = ["192.0.2.0/24", "2001:db8::/32"]
    ssh_keys      = ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGJlbGlldmVtZWl0aXNub3RhcmVhbGtleWF0YWxsISEh me"]
    package       = { source = "/opt/wheels/skytether-0.1.0-py3-none-any.whl[docker]", options = ["--no-index", "--find-links=/opt/wheels"] }
    images        = ["/opt/images/services.tar"]
    reboot_at     = "03:30"
  }

  assert {
    condition = strcontains(
      one([for file in yamldecode(output.user_data).write_files : file.content if file.path == "/usr/local/sbin/skytether-join"]),
      "skytether site join https://cloud.example.org:8603 --ports 30000-30009 --echo-port 8600 --advertise 203.0.113.7 --device /dev/video0 --token-file -",
    )
    error_message = "the machine joins its orchestrator with its ports, its address and its devices"
  }
  assert {
    condition = alltrue([for line in [
      "udp dport 30000-30009 accept",
      "udp dport 8600 accept",
      "ip saddr { 192.0.2.0/24 } tcp dport 22 accept",
      "ip6 saddr { 2001:db8::/32 } tcp dport 22 accept",
    ] : strcontains(output.user_data, line)])
    error_message = "the firewall opens the sessions to all and SSH to whom it is for"
  }
  assert {
    condition     = length(regexall("dport [0-9]", output.user_data)) == 6
    error_message = "the firewall opens DHCP, the sessions, the echo, SSH for two kinds of addresses, and nothing else"
  }
  assert {
    condition     = strcontains(output.user_data, "Automatic-Reboot-Time \\\"03:30\\\"") || strcontains(output.user_data, "Automatic-Reboot-Time \"03:30\"")
    error_message = "the machine restarts when it was told to"
  }
  assert {
    condition     = !strcontains(output.user_data, "skytether-join.service")
    error_message = "the token comes by SSH: nothing fetches one"
  }
  assert {
    condition     = output.next == "skytether site invite ward-3 --tier edge --valid 1h | ssh debian@203.0.113.7 sudo skytether-join"
    error_message = "the next command is shown"
  }
}

run "a_site_that_nobody_reaches" {
  variables {
    orchestrator  = "https://cloud.example.org"
    token_command = "aws ssm get-parameter --with-decryption --name /ward-3 --query Parameter.Value --output text"
  }

  assert {
    condition     = alltrue([for path in ["skytether-join.service", "/usr/local/sbin/skytether-token"] : strcontains(output.user_data, path)])
    error_message = "the machine fetches its token itself"
  }
  assert {
    condition     = !strcontains(output.user_data, "tcp dport")
    error_message = "no TCP port is open"
  }
}

run "machines_that_a_group_makes" {
  variables {
    name          = "@SKYTETHER_NAME@"
    orchestrator  = "@SKYTETHER_URL@"
    token_command = "echo @SKYTETHER_TOKEN@"
  }

  assert {
    condition = alltrue([for text in ["\"@SKYTETHER_NAME@\"", "site join @SKYTETHER_URL@ --ports", "echo @SKYTETHER_TOKEN@"] :
    strcontains(output.user_data, text)])
    error_message = "the orchestrator puts each machine's own words in"
  }
  assert {
    condition = one([
      for file in yamldecode(output.user_data).write_files : file.permissions if file.path == "/usr/local/sbin/skytether-token"
    ]) == "0700"
    error_message = "root alone reads the token"
  }
}

run "an_orchestrators_machine" {
  variables {
    engine = false
    open   = [{ protocol = "tcp", ports = "8600" }, { protocol = "udp", ports = "8600", from = ["0.0.0.0/0"] }]
  }

  assert {
    condition = alltrue([for line in [
      "meta nfproto ipv4 tcp dport 8600 accept", "meta nfproto ipv6 tcp dport 8600 accept", "meta nfproto ipv4 udp dport 8600 accept",
    ] : strcontains(output.user_data, line)])
    error_message = "the API is open"
  }
  assert {
    condition     = !strcontains(output.user_data, "20000-20099") && !strcontains(output.user_data, "docker")
    error_message = "without an engine there are no sessions, and no ports for them"
  }
}

run "both_ways_of_setting_up_are_one" {
  variables {
    orchestrator = "https://cloud.example.org"
    files        = { "/etc/motd" = { content = "A ward's machine.\n" } }
  }

  assert {
    condition = alltrue([
      for file in yamldecode(output.user_data).write_files :
      strcontains(output.setup, "put ${file.path} ${file.permissions} <<'END'\n${base64encode(file.content)}\nEND")
    ])
    error_message = "the script for a machine that runs already puts the same files there"
  }
}
