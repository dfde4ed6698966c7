"""``python -m skytether.cli``: the same as ``skytether``."""

from .main import main

main()
