"""The end of groups whose orchestrators are gone for good: no machine is left that costs anything."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from skytether.api.groups import Stage

from ..domain.errors import ConflictError
from ..domain.validation import parse
from ..providers.base import Condition, Provider, ProviderFailure
from ..runtimes.base import RuntimeFailure
from ..store.group_store import GroupRow
from ..store.leader import Lock
from ..store.store import Store
from .groups import load_provider

log = logging.getLogger(__name__)

_LOOK_S = 0.5


def end_groups(
    store: Store,
    names: Iterable[str],
    folder: Path,
    find_provider: Callable[[str], type[Provider]] = load_provider,
    patience_s: float = 600.0,
) -> list[str]:
    """Destroy all machines of groups, whatever runs there, and forget the groups.

    Args:
        store: The database that knows them; it is brought to our schema.
        names: Of the groups; of one that it does not know it is warned: it has no machines, or it is another's.
        folder: Where the providers keep what they note.
        find_provider: Gives a provider by its name.
        patience_s: How long each provider gets until it lists none of them.

    Returns:
        Names of the machines.

    Raises:
        ConflictError: An orchestrator leads, which would make others.
        OutdatedError: A newer orchestrator has brought the database to another schema.
        InvalidError: A provider is not installed, or does not take its options any more.
        RuntimeFailure: A provider does not answer, refuses, or lists machines still.
    """
    lock = store.lock()
    _hold(lock)
    try:
        store.migrate()
        ended: list[str] = []
        for name in names:
            row = store.site_group(name)
            if row is None:
                log.warning("this database knows no group '%s': if it is not its orchestrators', machines stay", name)
            else:
                ended += _end(store, row, folder / row.name, find_provider, patience_s, lock)
        return ended
    finally:
        lock.release()


def _hold(lock: Lock) -> None:
    if not lock.hold():
        raise ConflictError(
            "an orchestrator leads over this database, and would make other machines: end it first, or have it give "
            "them back (`skytether group delete NAME --drain`)"
        )


def _end(
    store: Store,
    row: GroupRow,
    folder: Path,
    find_provider: Callable[[str], type[Provider]],
    patience_s: float,
    lock: Lock,
) -> list[str]:
    kind = find_provider(row.asked.provider)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    rows = store.machines(row.name)
    ended = {machine.name for machine in rows}
    began = time.monotonic()
    try:
        provider = kind(row.name, row.owner, folder, parse(kind.Options, row.asked.options, prefix=("options",)))
        try:
            # One whose order got no answer may be listed a while later only.
            unsure = any(machine.stage is Stage.MAKING for machine in rows)
            settled = began + (provider.settle_s if unsure else 0.0)
            while (there := provider.machines()) or time.monotonic() < settled:
                _hold(lock)
                for found in there:
                    ended.add(found.name)
                    if found.condition is not Condition.GOING:
                        provider.destroy(found.id)
                if time.monotonic() - began > patience_s:
                    left = ", ".join(found.name for found in there)
                    raise RuntimeFailure(f"group {row.name}: {left} are there still after {patience_s:g} s")
                time.sleep(_LOOK_S)
        finally:
            provider.close()
    except ProviderFailure as error:
        raise RuntimeFailure(f"group {row.name}: {error}; machines may be left") from error
    for name in ended:
        store.delete_site(name)
    store.forget_machines(ended)
    store.delete_site_group(row.name)
    return sorted(ended)
