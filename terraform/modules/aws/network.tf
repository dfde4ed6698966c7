resource "aws_vpc" "this" {
  #checkov:skip=CKV2_AWS_11:flow logs cost by the packet, and sessions are many packets; they are yours to add
  cidr_block           = "10.86.0.0/16"
  enable_dns_hostnames = true
  tags                 = { Name = "skytether" }
}

# What is in no group of its own reaches nothing and is reached by nobody.
resource "aws_default_security_group" "closed" {
  vpc_id = aws_vpc.this.id
}

resource "aws_subnet" "zone" {
  for_each = module.network.subnets

  vpc_id            = aws_vpc.this.id
  cidr_block        = each.value
  availability_zone = "${var.region}${each.key}"
  tags              = { Name = "skytether-${each.key}" }
}

resource "aws_internet_gateway" "this" {
  vpc_id = aws_vpc.this.id
}

resource "aws_route_table" "this" {
  vpc_id = aws_vpc.this.id
}

resource "aws_route" "out" {
  route_table_id         = aws_route_table.this.id
  destination_cidr_block = "0.0.0.0/0"
  gateway_id             = aws_internet_gateway.this.id
}

resource "aws_route_table_association" "zone" {
  for_each = module.network.subnets

  subnet_id      = aws_subnet.zone[each.key].id
  route_table_id = aws_route_table.this.id
}

resource "aws_security_group" "kind" {
  for_each = toset(["orchestrator", "node"])

  name_prefix = "skytether-${each.key}-"
  description = "Skytether: ${each.key}"
  vpc_id      = aws_vpc.this.id

  lifecycle {
    create_before_destroy = true
  }
}

locals {
  # One resource of AWS for each rule and network. Nodes have no SSH: their token comes another way.
  let_in = {
    for kind in ["orchestrator", "node"] : kind => merge([
      for name, rule in module.network.rules[kind] : {
        for from in rule.from : "${name} ${from}" => merge(rule, { from = from })
      } if kind == "orchestrator" || name != "ssh"
    ]...)
  }
}

resource "aws_vpc_security_group_ingress_rule" "orchestrator" {
  for_each = local.let_in.orchestrator

  security_group_id = aws_security_group.kind["orchestrator"].id
  description       = each.value.description
  ip_protocol       = each.value.protocol
  from_port         = each.value.first
  to_port           = each.value.last
  cidr_ipv4         = strcontains(each.value.from, ":") ? null : each.value.from
  cidr_ipv6         = strcontains(each.value.from, ":") ? each.value.from : null
}

resource "aws_vpc_security_group_ingress_rule" "node" {
  for_each = local.let_in.node

  security_group_id = aws_security_group.kind["node"].id
  description       = each.value.description
  ip_protocol       = each.value.protocol
  from_port         = each.value.first
  to_port           = each.value.last
  cidr_ipv4         = strcontains(each.value.from, ":") ? null : each.value.from
  cidr_ipv6         = strcontains(each.value.from, ":") ? each.value.from : null
}

# Out: Debian's archive, the registry of images, the orchestrator, robots wherever they are.
resource "aws_vpc_security_group_egress_rule" "out" {
  for_each = aws_security_group.kind

  security_group_id = each.value.id
  description       = "to anywhere"
  ip_protocol       = "-1"
  cidr_ipv4         = "0.0.0.0/0"
}

# Addresses stay when machines are made anew, and are known before: they are in certificate and user-data.
resource "aws_eip" "orchestrator" {
  domain = "vpc"
  tags   = { Name = "skytether-orchestrator" }
}

resource "aws_eip_association" "orchestrator" {
  instance_id   = aws_instance.orchestrator.id
  allocation_id = aws_eip.orchestrator.id
}

resource "aws_eip" "node" {
  for_each = var.sites

  domain = "vpc"
  tags   = { Name = "skytether-${each.key}" }
}

resource "aws_eip_association" "node" {
  for_each = var.sites

  instance_id   = aws_instance.node[each.key].id
  allocation_id = aws_eip.node[each.key].id
}
