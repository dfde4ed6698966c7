"""The services that Skytether ships. Each imports ``skytether.service`` and ``skytether.messages`` only."""
