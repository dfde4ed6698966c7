"""Joined nodes: machines that call the orchestrator, and are sites by it; nothing calls them.

Who may join, their certificates, and the ways to their engines. What runs there is the Docker runtime's.
"""
