"""An orchestrator of a later version: this very code, with one migration more."""

from __future__ import annotations

import shutil
from pathlib import Path

import skytether

_NEXT = '''\
"""What a later version adds."""

import sqlalchemy as sa
from alembic import op

revision, down_revision, branch_labels, depends_on = "{number}", "{head}", None, None


def upgrade() -> None:
    op.add_column("instances", sa.Column("colour{number}", sa.String(8), nullable=False, server_default="red"))
'''


def newer_code(root: Path, head: str, before: Path | None = None) -> Path:
    """Make its source root.

    Args:
        root: Where; it is made.
        head: The newest revision so far.
        before: A source root that was made so, to which this adds; None: this very code.
    """
    copied = shutil.copytree(before / "skytether" if before else Path(skytether.__file__).parent, root / "skytether")
    number = int(head) + 1 if int(head) > 9000 else 9001
    (copied / f"orchestrator/store/migrations/versions/{number}_colour.py").write_text(
        _NEXT.format(head=head, number=number)
    )
    return root
