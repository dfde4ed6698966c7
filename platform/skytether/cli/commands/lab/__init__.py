"""``skytether lab``: experiments and benchmarks. What is measured, and how, is in `skytether.lab`."""
