"""The image so far: the sums of the first units of a plan, and the noise that they still have.

Units of even and of odd passes are added up apart, as two images of half the samples: what these
differ by tells the noise of the whole.
"""

from __future__ import annotations

import numpy as np

from glintbsdf.scene.passes import Tile
from glintbsdf.scene.units import Plan

#: From so many passes on, the noise of an image is known.
FEWEST_PASSES = 4


class Image:
    """The sums of the first units of a plan.

    Attributes:
        plan (Plan): the units that make the image.
        count (int): how many units are in the sums.
        sums (numpy.ndarray | None): (height, width, channels) float64; None before the first unit.
        odd (numpy.ndarray | None): the part of odd passes, in the channels up to the weight; None
            before the first unit.
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
            sums: sums of these pixels, (height, width, channels).
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
