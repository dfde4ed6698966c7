"""The mode that maps, without topics: what the robot senses goes in; its pose, a map and files come out.

Nobody is driven. Scans are matched, and maps drawn and written, in one thread beside the loop's, one after the other:
to close a loop takes longer than a step may.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path

from skytether.service import Rate
from skytether_services.planar.geometry import Pose
from skytether_services.planar.transforms import compose, inverse

from .grid_map import GridMap, MapError
from .map_builder import MapBuilder, Progress, save
from .params import Params
from .senses import LaserScan, Senses
from .status import Code, Trouble

WAITING = 50
"""Scans that wait to be matched, at most: six seconds. Of more the newest are left out; odometry bridges that."""
PATIENCE = 4.0
"""Whoever asks for a file waits so long for it [s]; a call lasts 5 s, and so may the end of a process."""
_LASTS = 5.0
"""A scan that failed is told for so long [s]."""
_NAMES = 1000
"""Maps of one name in a folder."""


class MappingMode:
    """Of one robot.

    Attributes:
        senses: What the robot measures goes there.
        progress: How far the map is; None: no scan was matched yet.
        new_map: Drawn last; None: none yet.
        saved: Where the map is; None: nowhere yet.
        dropped: Scans that found no place in the queue.
    """

    def __init__(self, params: Params, folder: Path, executor: Executor) -> None:
        """Begin where the parameter ``start`` says, or at the origin.

        Args:
            params: Of the service.
            folder: For the files.
            executor: Of one thread.

        Raises:
            ValueError: ``save_as`` is not a valid file name.
        """
        name = params.mapping.save_as
        if not name or name.startswith(".") or Path(name).name != name:
            raise ValueError(f"parameter 'mapping.save_as' is {name!r}: give a name without folders, such as 'map'")
        self._executor = executor
        self._builder = MapBuilder(params.start.pose if params.start is not None else Pose(0.0, 0.0, 0.0))
        self._save_due, self._draw_due = (
            Rate(1 / seconds if seconds else 0.0)
            for seconds in (params.mapping.save_every, params.mapping.publish_every)
        )
        self._path = _free_path(folder, name)
        self._scans: deque[tuple[Future[Progress], Pose]] = deque()
        self._drawing: Future[GridMap | None] | None = None
        self._saving: Future[GridMap | None] | None = None
        self._saved_scans = self._saving_scans = self._drawn_scans = 0
        self._map_from_odometry: Pose | None = None
        self._failed: tuple[float, Trouble] | None = None
        self._not_saved: Trouble | None = None
        self.senses = Senses(params.sensors, params.limits)
        self.progress: Progress | None = None
        self.new_map: GridMap | None = None
        self.saved: Path | None = None
        self.dropped = 0

    def step(self, now: float) -> None:
        """Take what the thread has done, and give it what is new."""
        self._collect(now)
        taken = self.senses.pop_scan(now)
        if taken is not None:
            self._match(*taken)
        scans = self.progress.scans if self.progress is not None else 0
        if self._saving is None and scans != self._saved_scans and self._save_due.due(now):
            self._saving = self._executor.submit(self._draw, self._path)
            self._saving_scans = scans
        if self._drawing is None and scans != self._drawn_scans and self._draw_due.due(now):
            self._drawing = self._executor.submit(self._draw, None)
            self._drawn_scans = scans

    def pose(self) -> Pose | None:
        """Of the robot on the map, as new as odometry is; None: not known."""
        newest = self.senses.dead_reckoning
        if newest is None or self._map_from_odometry is None:
            return None
        return compose(self._map_from_odometry, newest)

    def trouble(self, now: float) -> Trouble | None:
        """Why the map does not grow, or is not on the disk."""
        failed = self._failed[1] if self._failed is not None and now - self._failed[0] < _LASTS else None
        return self.senses.unheard(now) or self._not_saved or failed or self.senses.unsteady(now)

    def save(self) -> tuple[bool, str]:
        """Save the map now; returns whether that was done, and the path or why not."""
        future = self._executor.submit(self._draw, self._path)
        try:
            grid = future.result(PATIENCE)
        except TimeoutError:
            return False, f"The map is still being drawn after {PATIENCE:g} s; ask again, or look at the status."
        except MapError as error:
            self._not_saved = _not_saved(error)
            return False, self._not_saved.message
        except Exception as error:
            return False, f"The map cannot be drawn: {_text(error)}"
        if grid is None:
            return False, "There is no map yet: no scan was kept."
        self.new_map, self.saved, self._not_saved = grid, self._path, None
        return True, str(self._path)

    def close(self) -> tuple[bool, str]:
        """Save it a last time, as `save` does; the thread ends with what it is at."""
        done = self.save()
        self._executor.shutdown(wait=False, cancel_futures=True)
        return done

    def _match(self, scan: LaserScan, at_scan: Pose) -> None:
        if len(self._scans) >= WAITING:
            self.dropped += 1
        else:
            self._scans.append((self._executor.submit(self._builder.add, scan, at_scan), at_scan))

    def _collect(self, now: float) -> None:
        while self._scans and self._scans[0][0].done():
            future, at_scan = self._scans.popleft()
            if (error := future.exception()) is not None:
                self._failed = now, Trouble(Code.MAPPING_FAILED, f"A scan was left out: {_text(error)}")
                continue
            self.progress = future.result()
            self._map_from_odometry = compose(self.progress.pose, inverse(at_scan))
        if self._drawing is not None and self._drawing.done():
            self._drawn(self._drawing, now, lambda: None)
            self._drawing = None
        if self._saving is not None and self._saving.done():
            self._drawn(self._saving, now, self._was_saved)
            self._saving = None

    def _was_saved(self) -> None:
        self.saved, self._not_saved = self._path, None
        self._saved_scans = self._saving_scans

    def _drawn(self, future: Future[GridMap | None], now: float, then: Callable[[], None]) -> None:
        error = future.exception()
        if isinstance(error, MapError):
            self._not_saved = _not_saved(error)
        elif error is not None:
            self._failed = now, Trouble(Code.MAPPING_FAILED, f"The map cannot be drawn: {_text(error)}")
        elif (grid := future.result()) is not None:
            self.new_map = grid
            then()

    def _draw(self, path: Path | None) -> GridMap | None:
        """In the thread: draw the map, and write it where a path is given."""
        grid = self._builder.grid()
        if grid is not None and path is not None:
            save(grid, path)
        return grid


def _free_path(folder: Path, name: str) -> Path:
    """NAME.yaml, or NAME-2.yaml: a service that starts anew begins a map anew, and overwrites none."""
    names = (name, *(f"{name}-{number}" for number in range(2, _NAMES)))
    return next((path for one in names if not (path := folder / f"{one}.yaml").exists()), folder / f"{name}.yaml")


def _not_saved(error: MapError) -> Trouble:
    return Trouble(Code.NOT_SAVED, f"The map cannot be saved: {error}")


def _text(error: BaseException) -> str:
    return str(error) or type(error).__name__
