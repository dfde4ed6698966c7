"""``skytether site``: all of its commands."""

from __future__ import annotations

import typer

from ...lazy import Lazy, LazyGroup


class _Site(LazyGroup):
    table = {
        "list": Lazy("site.registry", "list_sites", "List the sites."),
        "show": Lazy("site.registry", "show_site", "Show one site."),
        "add": Lazy("site.registry", "add_site", "Add a place where instances run."),
        "delete": Lazy("site.registry", "delete_site", "Forget a site that has no instances."),
        "invite": Lazy(
            "site.registry",
            "invite_node",
            "Make a token with which one machine may join, once. It is printed on standard output, this once.",
        ),
        "join": Lazy(
            "site.machine",
            "join_node",
            "Make this machine a site. It calls the orchestrator; nothing has to call it, so it may be behind a NAT.",
        ),
        "run": Lazy("site.machine", "run_node", "Be the site that this machine joined as, until interrupted."),
        "leave": Lazy(
            "site.machine",
            "leave_node",
            "Undo the join of this machine: what runs here is moved elsewhere first, then nothing of it is left.",
        ),
        "drain": Lazy(
            "site.drain",
            "drain_site",
            "Have a site take no more instances, and move those that are there: before it is updated, say.",
        ),
        "resume": Lazy(
            "site.drain",
            "resume_site",
            "Have a site that was drained take instances again, and wait until it can: before the next one is drained.",
        ),
        "remove": Lazy(
            "site.drain",
            "remove_site",
            "Drain a site, and forget it with its last instance. The certificate of a machine that joined is no"
            " good then.",
        ),
    }


app = typer.Typer(cls=_Site, help="Where instances run.", no_args_is_help=True)
