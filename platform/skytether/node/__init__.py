"""The node's side of joining: a machine with a Docker engine that calls its orchestrators and is a site by it.

It opens every connection and listens to nobody but for an echo for probes. What is decided about instances is the
orchestrator's; what runs in containers is none of this.
"""
