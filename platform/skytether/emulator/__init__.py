"""Emulated links: what happens to a packet, between UDP sockets (`udp_link`) and in made-up time (`lossy_link`).

Tests, experiments and ``skytether bridge`` use them. Nothing here needs privileges; network namespaces are in
`skytether.lab.netns`.
"""
