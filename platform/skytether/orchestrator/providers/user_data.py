"""What a new machine is given to do at its first start: a file of the operator, with the machine's own words put in.

The file is whatever the cloud hands to its machines: cloud-init's ``#cloud-config``, or a script. Three words in it
stand for what only the orchestrator knows. A join token is good for one machine, once and for a short time; whoever may
read a machine's user-data in the cloud may read it.
"""

from __future__ import annotations

from pathlib import Path

from .base import Order, ProviderFailure

TOKEN, NAME, URL = "@SKYTETHER_TOKEN@", "@SKYTETHER_NAME@", "@SKYTETHER_URL@"


def read_template(path: Path) -> str:
    """The file, as it is now.

    Raises:
        ProviderFailure: It cannot be read, or a machine that has it could not join.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise ProviderFailure(f"user_data: {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ProviderFailure(f"user_data: {path} is not text: it is to hold cloud-init's user-data") from error
    if TOKEN not in text:
        raise ProviderFailure(f"user_data: {path} has no {TOKEN}: without a join token no machine becomes a site")
    return text


def render(path: Path, order: Order) -> str:
    """What one machine gets.

    Raises:
        ProviderFailure: The file cannot be read, or a machine that has it could not join.
    """
    if order.invitation is None:
        raise ProviderFailure(f"machine {order.name} has no invitation")
    text = read_template(path).replace(NAME, order.name).replace(URL, order.invitation.url)
    return text.replace(TOKEN, order.invitation.token)
