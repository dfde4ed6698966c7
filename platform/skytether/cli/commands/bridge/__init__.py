"""``skytether bridge``: its configuration file, and the ends that it makes."""
