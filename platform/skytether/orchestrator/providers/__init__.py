"""What makes machines for groups of sites: one file each. The contract is in ``base``; found by entry point.

How many there are to be is the business of ``groups``; a machine's way into a site, of ``nodes``.
"""
