"""Groups of sites: how many machines each has, and that their provider makes and destroys them.

What runs on a machine once it is a site is for `scheduling` to know; how a cloud is asked, for `providers`.
"""
