"""Photos of one command over processes: each opens the city once; what comes out is the same with one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from lodbench.citymap import CityMap
from lodbench.errors import WorkersGone
from lodbench.execution import Progress
from lodbench.execution.fan_out import Processes
from lodbench.execution.guards import single_threaded_blas
from lodbench.harness.photo.localize import OpenMap, open_map
from lodbench.harness.photo.prepare import PhotoRequest
from lodbench.segmentation.photo_segmenter import PackagedNetwork

Item = TypeVar("Item")
Result = TypeVar("Result")

# A worker begins within what two photos take: it is started for no fewer than this.
_PHOTOS_PER_WORKER = 4


def default_workers(request: PhotoRequest, photos: int) -> int:
    """Returns how many processes suit so many photos; others' methods and large networks run in this one."""
    is_own = type(request.method).__module__.startswith("lodbench.")
    if not is_own or not isinstance(request.segmenter, PackagedNetwork | None):
        return 1
    return max(1, min(os.cpu_count() or 1, photos // _PHOTOS_PER_WORKER))


@dataclass(slots=True, eq=False)
class PhotoWorker:
    """What works on photos: the request, and its city from where it is first looked at.

    Attributes:
        request: As for one photo; the photo's own fields count for nothing.
        opened: The city, where the process has it open; None else.
    """

    request: PhotoRequest
    opened: OpenMap | None = None
    _city_map: CityMap | None = None

    def place(self) -> OpenMap:
        """Returns the city.

        Raises:
            LodbenchError: It cannot be read.
        """
        self.opened = self.opened or open_map(self.request)
        return self.opened

    @property
    def city_map(self) -> CityMap:
        """Returns the map; beside other workers it is drawn by one thread."""
        self._city_map = self._city_map or CityMap(self.place().scene, threads=self.request.threads)
        return self._city_map


class PhotoWorkers:
    """Processes that work on photos, or this one; use ``photo_workers``."""

    def __init__(self, processes: Processes) -> None:
        self._processes = processes

    def each(
        self,
        label: str,
        work: Callable[[PhotoWorker, Item], Result],
        items: Mapping[int, Item],
        photos: Sequence[Path],
    ) -> Iterator[tuple[int, Result]]:
        """Yields the results of work on photos with their numbers, as they come, beside progress.

        Photos of one name are worked on one after the other: their files are numbered in their order.

        Args:
            label: Of the progress.
            work: Module-level function; what it takes and returns goes from process to process.
            items: By number in ``photos``.
            photos: All of them; those without an item are done.
        """
        batches: dict[object, list[tuple[int, Item]]] = {}
        for number, item in items.items():
            key = number if self._processes.count == 1 else photos[number].stem
            batches.setdefault(key, []).append((number, item))
        with Progress(label, len(photos), done=len(photos) - len(items)) as progress:
            for results in self._processes.map(partial(_work_here, work), batches.values()):
                yield from results
                progress.advance(len(results))


@contextmanager
def photo_workers(request: PhotoRequest, opened: OpenMap | None = None) -> Iterator[PhotoWorkers]:
    """Holds ``request.workers`` processes for the block; one is this process.

    Args:
        request: As for one photo.
        opened: Its city, if it is open here.

    Raises:
        WorkersGone: They keep dying.
    """
    own = opened if request.workers == 1 else None
    try:
        with closing(Processes(request.workers, _begin_here, (request, own))) as processes:
            yield PhotoWorkers(processes)
    except WorkersGone as fault:
        raise WorkersGone(fault.message, "`--workers 1` works in one process, with less memory.") from fault
    finally:
        _here.clear()


# What this process works with; set once, before its first photo.
_here: list[PhotoWorker] = []


def _begin_here(request: PhotoRequest, opened: OpenMap | None) -> None:
    _here[:] = [PhotoWorker(request, opened)]


@single_threaded_blas
def _work_here(
    work: Callable[[PhotoWorker, Item], Result], batch: Sequence[tuple[int, Item]]
) -> list[tuple[int, Result]]:
    return [(number, work(_here[0], item)) for number, item in batch]
