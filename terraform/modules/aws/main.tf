# An orchestrator and sites on AWS. Nodes let nobody in but robots: each fetches its join token from the Parameter Store by its
# own identity, and calls the orchestrator.

locals {
  zones    = distinct(concat([var.orchestrator.zone], [for site in values(var.sites) : site.zone]))
  machines = merge(var.sites, { orchestrator = { machine_type = var.orchestrator.machine_type, zone = var.orchestrator.zone, disk = 20 } })
}

module "network" {
  source = "../network"

  zones         = local.zones
  robots_from   = var.robots_from
  ssh_from      = var.ssh_from
  session_ports = var.session_ports
}

module "orchestrator" {
  source = "../orchestrator"

  address    = aws_eip.orchestrator.public_ip
  more_names = [aws_eip.orchestrator.public_dns]
  ssh_user   = "admin"
  ssh_from   = var.ssh_from
  package    = var.package
  open       = module.network.open.orchestrator
}

module "node" {
  source   = "../node"
  for_each = var.sites

  name          = each.key
  orchestrator  = module.orchestrator.nodes_url
  session_ports = var.session_ports
  advertise     = aws_eip.node[each.key].public_ip
  package       = var.package
  packages      = ["awscli"]
  token_command = "aws --region ${var.region} ssm get-parameter --with-decryption --name ${local.parameter[each.key]} --query Parameter.Value --output text"
}

module "site" {
  source   = "../site"
  for_each = var.sites

  name    = each.key
  machine = aws_instance.node[each.key].id
  tier    = "cloud"
  cli     = module.orchestrator.cli
  deliver = ["aws", "--region", var.region, "ssm", "put-parameter", "--overwrite", "--type", "SecureString", "--name", local.parameter[each.key], "--value", "file:///dev/stdin"]
  forget  = ["aws", "--region", var.region, "ssm", "delete-parameter", "--name", local.parameter[each.key]]

  depends_on = [aws_eip_association.orchestrator, aws_instance.orchestrator, aws_vpc_security_group_ingress_rule.orchestrator, aws_iam_role_policy.node]
}

locals {
  parameter = { for name in keys(var.sites) : name => "/skytether/${name}/join" }
}

# -- Machines

data "aws_ami" "debian" {
  most_recent = true
  owners      = ["136693071363"] # Debian's own account

  filter {
    name   = "name"
    values = ["debian-12-amd64-*"]
  }
}

data "aws_ec2_instance_type_offerings" "here" {
  for_each = toset([for machine in values(local.machines) : machine.machine_type])

  location_type = "availability-zone"
  filter {
    name   = "instance-type"
    values = [each.key]
  }
}

resource "aws_key_pair" "operator" {
  key_name_prefix = "skytether-"
  public_key      = var.ssh_key
}

resource "aws_instance" "orchestrator" {
  #checkov:skip=CKV2_AWS_41:it needs nothing of the cloud, and so has no role
  ami                         = data.aws_ami.debian.id
  instance_type               = var.orchestrator.machine_type
  subnet_id                   = aws_subnet.zone[var.orchestrator.zone].id
  vpc_security_group_ids      = [aws_security_group.kind["orchestrator"].id]
  key_name                    = aws_key_pair.operator.key_name
  user_data_base64            = base64gzip(module.orchestrator.user_data)
  user_data_replace_on_change = false # its state is on its disk
  ebs_optimized               = true
  monitoring                  = true
  tags                        = { Name = "skytether-orchestrator" }

  metadata_options {
    http_tokens                 = "required"
    http_put_response_hop_limit = 1
  }
  root_block_device {
    encrypted   = true
    volume_size = 20
    volume_type = "gp3"
  }

  lifecycle {
    ignore_changes = [ami]
    precondition {
      condition     = contains(data.aws_ec2_instance_type_offerings.here[var.orchestrator.machine_type].locations, "${var.region}${var.orchestrator.zone}")
      error_message = "${var.region}${var.orchestrator.zone} has no machines of type ${var.orchestrator.machine_type} (the orchestrator's): `aws ec2 describe-instance-type-offerings --location-type availability-zone --region ${var.region}` lists what there is."
    }
  }
}

resource "aws_instance" "node" {
  for_each = var.sites

  ami                         = data.aws_ami.debian.id
  instance_type               = each.value.machine_type
  subnet_id                   = aws_subnet.zone[each.value.zone].id
  vpc_security_group_ids      = [aws_security_group.kind["node"].id]
  iam_instance_profile        = aws_iam_instance_profile.node[each.key].name
  user_data_base64            = base64gzip(module.node[each.key].user_data)
  user_data_replace_on_change = true
  ebs_optimized               = true
  monitoring                  = true
  tags                        = { Name = "skytether-${each.key}" }

  # One hop: what runs in a container gets neither user-data nor the machine's identity.
  metadata_options {
    http_tokens                 = "required"
    http_put_response_hop_limit = 1
  }
  root_block_device {
    encrypted   = true
    volume_size = each.value.disk
    volume_type = "gp3"
  }

  lifecycle {
    ignore_changes = [ami]
    precondition {
      condition     = contains(data.aws_ec2_instance_type_offerings.here[each.value.machine_type].locations, "${var.region}${each.value.zone}")
      error_message = "${var.region}${each.value.zone} has no machines of type ${each.value.machine_type} (site ${each.key}): `aws ec2 describe-instance-type-offerings --location-type availability-zone --region ${var.region}` lists what there is."
    }
  }
}

# What a node may do in the account: read its own join token.
resource "aws_iam_role" "node" {
  for_each = var.sites

  name_prefix = "skytether-${substr(each.key, 0, 24)}-"
  assume_role_policy = jsonencode({
    Version   = "2012-10-17"
    Statement = [{ Effect = "Allow", Action = "sts:AssumeRole", Principal = { Service = "ec2.amazonaws.com" } }]
  })
}

data "aws_caller_identity" "here" {}

resource "aws_iam_role_policy" "node" {
  for_each = var.sites

  name_prefix = "join-token-"
  role        = aws_iam_role.node[each.key].id
  policy = jsonencode({
    Version = "2012-10-17"
    Statement = [{
      Effect   = "Allow"
      Action   = "ssm:GetParameter"
      Resource = "arn:aws:ssm:${var.region}:${data.aws_caller_identity.here.account_id}:parameter${local.parameter[each.key]}"
    }]
  })
}

resource "aws_iam_instance_profile" "node" {
  for_each = var.sites

  name_prefix = "skytether-${substr(each.key, 0, 24)}-"
  role        = aws_iam_role.node[each.key].name
}
