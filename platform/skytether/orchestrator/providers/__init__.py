"""What makes machines for groups of sites: one file each. The contract is in ``base``; found by entry point."""
