"""What compose.yaml needs before its first start, made where it is not there yet; run by two containers of it.

``first_start.py passwords`` makes the database's password and that of Grafana's administrator;
``first_start.py token URL`` asks the orchestrator for a token with which Prometheus may read measurements.
Each is in a volume of its own, which only those mount who need it: a file there may be readable by all of them.
"""

from __future__ import annotations

import os
import secrets
import sys
from pathlib import Path

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import TokenCreate

SECRETS = Path("/secrets")
OPERATOR = Path("/var/lib/skytether/operator.token")


def keep(path: Path, content: str, mode: int = 0o444) -> None:
    """Write a file, complete or not at all."""
    draft = path.with_name(f"{path.name}.new")
    draft.unlink(missing_ok=True)
    with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.chmod(mode)
    draft.replace(path)


def password(path: Path) -> str:
    """The one in a file, made if it is not there."""
    if not path.exists():
        keep(path, secrets.token_hex(24))
        print(f"made {path}")
    return path.read_text()


def passwords(folder: Path = SECRETS) -> None:
    """Of the database, also in the form that PostgreSQL's clients read, and of Grafana."""
    database = password(folder / "database" / "password")
    keep(folder / "database" / "pgpass", f"*:*:*:*:{database}\n", 0o600)
    password(folder / "grafana" / "admin_password")


def token(url: str, folder: Path = SECRETS, operator: Path = OPERATOR) -> None:
    """Prometheus' own, made anew if the one that is there is worth nothing."""
    path = folder / "prometheus" / "token"
    if path.exists():
        try:
            with Client(url, path.read_text(), insecure_http=True) as client:  # within the stack's own network
                client.metrics()
                return
        except ApiError as error:
            print(f"the token in {path} is made anew: {error}")
    with Client(url, operator.read_text().strip(), insecure_http=True) as client:
        for old in client.tokens():
            if old.robot is None and old.name == "prometheus":
                client.delete_token(old.id)
        keep(path, client.create_token(TokenCreate(name="prometheus", scopes=("metrics",))).token)
    print(f"made {path}")


def main(arguments: list[str]) -> int:
    """The command."""
    try:
        match arguments:
            case ["passwords"]:
                passwords()
            case ["token", url]:
                token(url)
            case _:
                print(__doc__, file=sys.stderr)
                return 2
    except (ApiError, Unreachable, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
