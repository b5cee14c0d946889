"""Merging: the sums of units become one image, the same whatever the order in which units arrive.

Sums of double precision are added in the order of the plan. A unit that arrives early waits for
those before it, on disk where many wait. Units of even and of odd passes are added up apart, as two
images of half the samples: what these differ by tells the noise of the whole.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from glintbsdf.scene.passes import Tile
from glintbsdf.scene.storage import Checkpoint, Damaged, UnitFiles
from glintbsdf.scene.units import Plan, Unit

#: What units yield as they are done; None says that time has passed and nothing else.
Results = Iterator["tuple[Unit, Tile, np.ndarray] | None"]

#: Memory of units that wait for others, bytes; what is more waits on disk.
WAITING = 256 << 20

#: Passes from which the noise of an image is told.
FEWEST_PASSES = 4


class Image:
    """The sums of the first units of a plan.

    Attributes:
        plan (Plan): of the image.
        count (int): units that are in.
        sums (numpy.ndarray | None): (height, width, channels) float64; None before the first unit.
        odd (numpy.ndarray | None): the part of odd passes, in the channels up to the weight.
    """

    def __init__(self, plan: Plan, base_channels: int) -> None:
        self.plan, self.base_channels = plan, base_channels
        self.count = 0
        self.sums: np.ndarray | None = None
        self.odd: np.ndarray | None = None

    def add(self, tile: Tile, sums: np.ndarray) -> None:
        """Add the unit that is next in the plan.

        Args:
            tile: pixels that its samples reach.
            sums: (height, width, channels) of these.
        """
        film = self.plan.film
        if self.sums is None:
            self.sums = np.zeros((film.height, film.width, sums.shape[-1]))
            self.odd = np.zeros((film.height, film.width, self.base_channels))
        rows, columns = tile.slices(within=film)
        self.sums[rows, columns] += sums
        if self.plan[self.count].part % 2:
            self.odd[rows, columns] += sums[..., : self.base_channels]
        self.count += 1

    @property
    def fraction(self) -> float:
        """How much of the image is in, in [0, 1]."""
        return self.count / len(self.plan)

    @property
    def passes(self) -> int:
        """Passes that are in for every pixel."""
        return self.count // len(self.plan.tiles)

    @property
    def spp(self) -> int:
        """Samples that every pixel has."""
        return self.plan.spp * self.passes // self.plan.parts

    @property
    def noise(self) -> float | None:
        """Standard error of a pixel's colours, root mean square over the image, over their mean.

        None where fewer than :data:`FEWEST_PASSES` passes tell it, or the image is black.
        """
        if self.passes < FEWEST_PASSES:
            return None
        odd, even = self.odd, self.sums[..., : self.base_channels] - self.odd
        weights = [half[..., -1:] for half in (even, odd)]
        if any((weight <= 0).any() for weight in weights):
            return None
        a, b = (half[..., :3] / weight for half, weight in zip((even, odd), weights, strict=True))
        # Of the same samples, halves of N₁ and N₂ have the variance σ²/N₁ + σ²/N₂ in their
        # difference, and σ²/(N₁ + N₂) in their mean.
        n1, n2 = (float(weight.mean()) for weight in weights)
        mean = abs(float(((n1 * a + n2 * b) / (n1 + n2)).mean()))
        difference = float(np.sqrt(np.mean(np.square(a - b))))
        return difference * (n1 * n2) ** 0.5 / (n1 + n2) / mean if mean > 0 else None


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
        image: empty.
        render: yields the units that it gets, in any order, with their tiles and sums.
        checkpoint: keeps what is done, and gives what it has.
        until_noise: ends where :attr:`Image.noise` after a pass is no more than that. The image
            does not depend on the units that are under way then.
        time_limit: ends after so many seconds.
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
            """Add what is there and next; whether that is enough."""
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
    """Units that are done and not yet in the image: those of the checkpoint, and in memory."""

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
