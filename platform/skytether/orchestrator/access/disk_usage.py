"""What robots' services have written and left at sites, in sum; who has too much, and which site is full.

Sites weigh it now and then (``Runtime.stored``), at the orchestrator that leads: what is told here may be minutes old.
What a machine that joined says is somebody else's word: of robots that had nothing to do there it counts nowhere else.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping

from ..config.settings import Quotas


class DiskUsage:
    """Data on disk by site and robot. Pure but for what it asks."""

    def __init__(
        self,
        weighed: Callable[[], Mapping[str, Mapping[str, int]]],
        quotas: Quotas,
        believed: Callable[[str], Collection[str] | None] = lambda _: None,
    ) -> None:
        """What it sums up.

        Args:
            weighed: By site, bytes by robot, as far as that is known.
            quotas: How much there may be.
            believed: The robots of which a site's word counts beyond it; None: all.
        """
        self._weighed = weighed
        self._believed = believed
        self._robot, self._site = quotas.robot_data_mb << 20, quotas.site_data_mb << 20

    def by_robot(self) -> dict[str, int]:
        """Bytes of each at all sites."""
        return self._sums(self._weighed())

    def of(self, robot: str) -> int:
        """The same of one."""
        return self.by_robot().get(robot, 0)

    def by_site(self) -> dict[str, int]:
        """Bytes of all robots at each."""
        return {site: sum(robots.values()) for site, robots in self._weighed().items()}

    def full(self) -> dict[str, str]:
        """Which sites are, and so why nothing more is started there."""
        most = f"{mb(self._site)} may be (quotas.site_data_mb)"
        return {
            site: f"{mb(there)} MiB of data are there, and {most}"
            for site, there in self.by_site().items()
            if there > self._site
        }

    def too_much(self, site: str) -> dict[str, str]:
        """Who may write no more at a site, and why; continues "the service ...".

        At a site that is full those end who have more than they would have if all had the same.
        """
        weighed = self._weighed()
        there, advice = weighed.get(site, {}), "delete what is not needed"
        found = {}
        if sum(there.values()) > self._site:
            found = {
                robot: f"writes at a full site, where robot '{robot}' has {mb(size)} MiB, more than its share "
                f"of {mb(self._site)} (quotas.site_data_mb): {advice}"
                for robot, size in there.items()
                if size > self._site / len(there)
            }
        return found | {
            robot: f"has, with all others of robot '{robot}', {mb(size)} MiB of data, and may have {mb(self._robot)} "
            f"(quotas.robot_data_mb): {advice}"
            for robot, size in self._sums(weighed).items()
            if size > self._robot
        }

    def _sums(self, weighed: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
        sums: Counter[str] = Counter()
        for site, robots in weighed.items():
            believed = self._believed(site)
            sums.update(robots if believed is None else {name: robots[name] for name in robots.keys() & believed})
        return dict(sums)


def mb(count: int) -> int:
    """Bytes in MiB, so that the first one beyond a bound is one more."""
    return -(-count // (1 << 20))
