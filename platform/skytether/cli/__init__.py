"""The command line: thin. Each command checks its input, calls the package that does the work, prints.

Heavy imports belong inside the commands, so that ``skytether --help`` is quick and a robot needs no server.
"""
