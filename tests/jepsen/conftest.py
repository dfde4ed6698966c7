from __future__ import annotations

import gc
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from .cluster import Cluster, cluster

if TYPE_CHECKING:
    from docker_site import Images


@pytest.fixture
def clusters(postgres_programs: None, nftables: None) -> Iterator[Callable[..., Cluster]]:
    """Makes one; its folder stays, for its path is told when something was found."""
    with ExitStack() as stack:

        def make(faketime: str | None, images: Images | None) -> Cluster:
            folder = Path(tempfile.mkdtemp(prefix="skytether-jepsen-"))
            return stack.enter_context(cluster(folder, faketime, images))

        yield make
    gc.collect()  # Docker's client leaves sockets where no engine answers: now, while the test's filter ignores them


@pytest.fixture
def seed() -> int:
    """``SEED``, or another one each time."""
    return int(os.environ.get("SEED") or secrets.randbelow(1_000_000))
