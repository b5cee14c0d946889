"""Merging: the sums of units become one image, whatever the order in which units arrive.

Sums are added in double precision and in the order of the plan. So the image is the same to the
last bit. A unit that arrives early waits for the units before it; if many wait, they do so on disk.
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

#: Yields units when they are done. None means that time has passed without a new one.
Results = Generator["tuple[Unit, Tile, np.ndarray] | None", None, None]

#: Bytes of memory for units that wait for others; more units wait on disk.
WAITING = 256 << 20


def merge(
    image: Image,
    render: Callable[[Iterator[Unit]], Results],
    checkpoint: Checkpoint | None = None,
    until_noise: float | None = None,
    time_limit: float | None = None,
    observe: Callable[[Image], None] = lambda image: None,
) -> None:
    """Render the units of a plan and add them to ``image``, which always has the sum so far.

    Args:
        image: an empty image.
        render: function of units that yields them in any order, with their tiles and sums.
        checkpoint: keeps the units that are done. If it has some already, they are not rendered.
        until_noise: stop after the first pass whose :attr:`Image.noise` is at most this. Units that
            are being rendered at this moment do not count.
        time_limit: stop after this many seconds.
        observe: function that is called after every addition.
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
            """Add all units that come next and are done. Returns whether to stop."""
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
    """Units that are done but not yet in the image; they are in memory, in the checkpoint or in a
    temporary folder."""

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
        """Whether a unit is done. A damaged file does not count, and is removed."""
        if index in self.memory:
            return True
        try:
            return self.files.load(index) is not None
        except Damaged:
            self.files.remove(index)
            return False

    def take(self, index: int) -> tuple[Tile, np.ndarray] | None:
        """A unit that is done, or None. It is removed here, but not from a checkpoint."""
        found = self.memory.pop(index, None)
        if found is None:
            try:
                found = self.files.load(index)
            except Damaged:
                found = None
        if not self.durable:
            self.files.remove(index)
        return found
