"""What is known of pods, by their names and by their instances: of thousands, one is found without a look at all."""

from __future__ import annotations

from collections.abc import Iterable

from .seen import PodState


class Pods:
    """Those of one site. Not for several threads at once."""

    def __init__(self, pods: Iterable[PodState] = ()) -> None:
        self._named: dict[str, PodState] = {}
        self._of: dict[str, dict[str, PodState]] = {}
        for seen in pods:
            self.put(seen)

    def get(self, name: str) -> PodState | None:
        return self._named.get(name)

    def put(self, seen: PodState) -> None:
        """In the place of what was known under its name."""
        self._named[seen.name] = seen
        self._of.setdefault(seen.instance, {})[seen.name] = seen

    def drop(self, name: str) -> None:
        seen = self._named.pop(name)
        del self._of[seen.instance][name]
        if not self._of[seen.instance]:
            del self._of[seen.instance]

    def of(self, instance: str) -> list[PodState]:
        """Of one instance, the newest run last."""
        return sorted(self._of.get(instance, {}).values(), key=lambda seen: seen.attempt)

    def all(self) -> list[PodState]:
        return list(self._named.values())
