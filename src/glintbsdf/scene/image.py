"""An unfinished image: the sums of the first units of a plan, and an estimate of their noise.

Units of even passes and units of odd passes are summed separately. The difference of these two
images, which have half of the samples each, gives the noise of the whole.
"""

from __future__ import annotations

import numpy as np

from glintbsdf.scene.passes import Tile
from glintbsdf.scene.units import Plan

#: Smallest number of passes for an estimate of the noise.
FEWEST_PASSES = 4


class Image:
    """The sums of the first units of a plan.

    Attributes:
        plan (Plan): the units that make the image.
        count (int): number of units in the sums.
        sums (numpy.ndarray | None): (height, width, channels) float64; None before the first unit.
        odd (numpy.ndarray | None): sums of odd passes alone, for the channels up to the weight;
            None before the first unit.
    """

    def __init__(self, plan: Plan, base_channels: int) -> None:
        self.plan, self.base_channels = plan, base_channels
        self.count = 0
        self.sums: np.ndarray | None = None
        self.odd: np.ndarray | None = None

    def add(self, tile: Tile, sums: np.ndarray) -> None:
        """Add the next unit of the plan.

        Args:
            tile: pixels that samples of the unit reach.
            sums: sums of samples in these pixels, (height, width, channels).
        """
        film = self.plan.film
        if self.sums is None or self.odd is None:
            self.sums = np.zeros((film.height, film.width, sums.shape[-1]))
            self.odd = np.zeros((film.height, film.width, self.base_channels))
        rows, columns = tile.slices(within=film)
        self.sums[rows, columns] += sums
        if self.plan[self.count].part % 2:
            self.odd[rows, columns] += sums[..., : self.base_channels]
        self.count += 1

    @property
    def fraction(self) -> float:
        """The fraction of units in the sums, in [0, 1]."""
        return self.count / len(self.plan)

    @property
    def passes(self) -> int:
        """Number of passes that are complete."""
        return self.count // len(self.plan.tiles)

    @property
    def spp(self) -> int:
        """Number of samples that every pixel has."""
        return self.plan.spp * self.passes // self.plan.parts

    @property
    def noise(self) -> float | None:
        """Standard error of a pixel's colours, root mean square over the image, over their mean.

        None for fewer than :data:`FEWEST_PASSES` passes, and for a black image.
        """
        if self.sums is None or self.odd is None or self.passes < FEWEST_PASSES:
            return None
        odd, even = self.odd, self.sums[..., : self.base_channels] - self.odd
        weights = [half[..., -1:] for half in (even, odd)]
        if any((weight <= 0).any() for weight in weights):
            return None
        a, b = (half[..., :3] / weight for half, weight in zip((even, odd), weights, strict=True))
        # Halves of N₁ and N₂ samples of variance σ² differ with the variance σ²/N₁ + σ²/N₂; their
        # mean has the variance σ²/(N₁ + N₂).
        n1, n2 = (float(weight.mean()) for weight in weights)
        mean = abs(float(((n1 * a + n2 * b) / (n1 + n2)).mean()))
        difference = float(np.sqrt(np.mean(np.square(a - b))))
        return difference * (n1 * n2) ** 0.5 / (n1 + n2) / mean if mean > 0 else None
