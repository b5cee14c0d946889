"""Merging: the sums of units become one image, the same whatever the order in which units arrive.

Sums of double precision are added in the order of the plan. A unit that arrives early waits for
the units before it, on disk where many wait.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np

from glintbsdf.scene.image import Image
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.storage import Checkpoint, Damaged, UnitFiles
from glintbsdf.scene.units import Unit

#: Yields units as they are done; None says that time has passed and nothing else.
Results = Generator["tuple[Unit, Tile, np.ndarray] | None", None, None]

#: Units that wait for others take at most so many bytes of memory; the rest waits on disk.
WAITING = 256 << 20


def merge(
    image: Image,
    render: Callable[[Iterator[Unit]], Results],
    checkpoint: Checkpoint | None = None,
    until_noise: float | None = None,
    time_limit: float | None = None,
    observe: Callable[[Image], None] = lambda image: None,
) -> None:
    """Render the units of a plan and add them to ``image``, which holds what is in at any time.

    Args:
        image: an empty image.
        render: yields the units that it gets, in any order, with their tiles and sums.
        checkpoint: keeps what is done, and gives what it has.
        until_noise: the work ends after a pass whose :attr:`Image.noise` is no more than that. The
            image does not depend on the units that are under way then.
        time_limit: the work ends after so many seconds.
        observe: called whenever something has been added.
    """
    plan = image.plan
    begun = time.monotonic()
    if checkpoint is not None:
        checkpoint.restore(image)
    with tempfile.TemporaryDirectory(prefix="glintbsdf-") as folder:
        waiting = _Waiting(UnitFiles(Path(folder)), checkpoint)

        def satisfied() -> bool:
            if until_noise is None or image.count % len(plan.tiles):
                return False
            noise = image.noise
            return noise is not None and noise <= until_noise

        def advance() -> bool:
            """Add what is there and comes next; return whether that is enough."""
            added = False
            while image.count < len(plan) and not satisfied():
                found = waiting.take(image.count)
                if found is None:
                    break
                image.add(*found)
                added = True
                if checkpoint is not None:
                    checkpoint.progressed(image)
            if added:
                observe(image)
            late = time_limit is not None and time.monotonic() - begun >= time_limit
            return late or satisfied()

        def missing() -> Iterator[Unit]:
            for index in range(image.count, len(plan)):
                if not waiting.holds(index):
                    yield plan[index]

        if advance():
            return
        results = render(missing())
        try:
            for result in results:
                if result is not None:
                    unit, tile, sums = result
                    waiting.put(unit.index, tile, sums)
                if advance():
                    return
        finally:
            results.close()
        advance()


class _Waiting:
    """Units that are done and not yet in the image: in the checkpoint and in memory."""

    def __init__(self, spare: UnitFiles, checkpoint: Checkpoint | None) -> None:
        self.files = spare if checkpoint is None else checkpoint.units
        self.durable = checkpoint is not None
        self.memory: dict[int, tuple[Tile, np.ndarray]] = {}

    def put(self, index: int, tile: Tile, sums: np.ndarray) -> None:
        full = sum(held.nbytes for _, held in self.memory.values()) + sums.nbytes > WAITING
        if self.durable or full:
            self.files.save(index, tile, sums)
        if not full:
            self.memory[index] = tile, sums

    def holds(self, index: int) -> bool:
        """Whether a unit is there; one that is damaged is not."""
        if index in self.memory:
            return True
        try:
            return self.files.load(index) is not None
        except Damaged:
            self.files.remove(index)
            return False

    def take(self, index: int) -> tuple[Tile, np.ndarray] | None:
        """A unit that is there, or None. In a checkpoint it stays."""
        found = self.memory.pop(index, None)
        if found is None:
            try:
                found = self.files.load(index)
            except Damaged:
                found = None
        if not self.durable:
            self.files.remove(index)
        return found
