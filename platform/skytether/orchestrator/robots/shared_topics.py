"""What services of robots of one group share: each one's last word, for the same services of the others.

The orchestrator reads none of it. Who is in a group is an operator's to say; a robot's word is known by the token that
it came with; each has one word for each service, of `rest.MOST_SHARED` bytes, for `KEPT_S`. Any orchestrator may
be asked: words and groups go through the database once a second, and requests wait for none of that.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from skytether.api.rest import MOST_NEIGHBOURS, Neighbours, Share, Shared

from ..access.access import Principal
from ..domain.errors import ConflictError, ForbiddenError, NotFoundError
from ..domain.records import Record
from ..store.database import SharedRow
from ..store.store import Store

KEPT_S = 60.0
"""What a robot said longer ago is told nobody."""
_Key = tuple[str, str]


class SharedTopics:
    """Safe from any thread.

    Args:
        store: Where groups and words are.
        clock: Seconds since the epoch, the same for all orchestrators.
    """

    def __init__(self, store: Store, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock
        self._groups: dict[str, str] | None = None
        """By robot; None: not read yet."""
        self._words: dict[_Key, SharedRow] = {}
        """By robot and service, the newest of all that is known."""
        self._unwritten: set[_Key] = set()
        self._lock = threading.Lock()
        self._syncing = threading.Lock()

    def put(self, robot: str, group: str | None) -> None:
        """Put a robot into a group, or out of its group.

        Raises:
            NotFoundError: There is no such robot.
        """
        if not self._store.set_group(robot, group):
            raise NotFoundError(f"there is no robot '{robot}': register it first")
        self.learn_groups()

    def learn_groups(self) -> None:
        """See who is in which group now; otherwise it is seen within a second."""
        groups = self._store.groups()
        with self._lock:
            self._groups = groups

    def share(self, by: Principal, record: Record, share: Share) -> Neighbours:
        """Take what a robot's service says, and tell what the others of its group said.

        Raises:
            ForbiddenError: It is not the instance's robot.
            ConflictError: The service shares nothing, or the instance has ended.
        """
        if by.robot != record.robot:
            raise ForbiddenError(f"only robot '{record.robot}' itself shares what its service sees")
        if record.spec.shared("in") is None and record.spec.shared("out") is None:
            raise ConflictError(f"service '{record.service}' shares nothing: no topic of its manifest is shared")
        if record.state.final:
            raise ConflictError(f"instance '{record.id}' is {record.state}: ask for a new one")
        if self._groups is None:
            self.learn_groups()
        now = self._clock()
        with self._lock:
            groups = self._groups or {}
            group = groups.get(record.robot)
            if group is None:
                return Neighbours()
            key = (record.robot, record.service)
            if share.text is not None and record.spec.shared("out") is not None:
                self._words[key] = SharedRow(*key, group, now - share.age_s, share.text)
                self._unwritten.add(key)
            if record.spec.shared("in") is None:
                return Neighbours(group=group)
            words = [
                word
                for (robot, service), word in self._words.items()
                if service == record.service and robot != record.robot and groups.get(robot) == word.group == group
            ]
        # Either way: a clock that was set back must not keep a word for as long as that.
        fresh = sorted((word for word in words if abs(now - word.at) <= KEPT_S), key=lambda word: -word.at)
        others = (Shared(robot=w.robot, age_s=max(0.0, now - w.at), text=w.text) for w in fresh[:MOST_NEIGHBOURS])
        return Neighbours(group=group, others=tuple(others))

    def sync(self) -> None:
        """Bring what was said here into the database, and learn what was said to other orchestrators.

        If that fails, what was said is kept for the next time.
        """
        with self._syncing:
            self.learn_groups()
            with self._lock:
                if not self._groups and not self._words:
                    return
                keys, self._unwritten = self._unwritten, set()
                said = [self._words[key] for key in keys]
            try:
                self._store.save_shared(said, self._clock() - KEPT_S)
            except BaseException:
                with self._lock:
                    self._unwritten |= keys
                raise
            stored = self._store.shared()
            with self._lock:
                for row in stored:
                    known = self._words.get((row.robot, row.service))
                    if known is None or known.at < row.at:
                        self._words[row.robot, row.service] = row
                now, groups = self._clock(), self._groups or {}
                self._words = {
                    key: word for key, word in self._words.items() if key[0] in groups and abs(now - word.at) <= KEPT_S
                }
                self._unwritten &= self._words.keys()
