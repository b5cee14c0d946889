"""The figures' axes: what a reader measures on them is what was drawn."""

from __future__ import annotations

import numpy as np
import pytest

from glintbsdf.check import plot
from glintbsdf.check.comparison import Comparison
from glintbsdf.check.reference import BinnedPNDF
from glintbsdf.footprint.gaussian import Footprint


def compared(bounds) -> Comparison:
    """A comparison of a uniform density with itself over a range of normals, without a map."""
    density = np.full((8, 8), 1 / np.pi)
    reference = BinnedPNDF(density, 0.1 * density, bounds)
    footprint = Footprint(uv=[0.5, 0.5], du=[0.1, 0], dv=[0, 0.1])
    return Comparison("uniform", density, 0.1 * density, reference, 64, 1.0, footprint, None)


@pytest.mark.parametrize(
    ("bounds", "degrees"),
    [
        (((-1, -1), (1, 1)), ([-60, -30, 0, 30, 60], [-60, -30, 0, 30, 60])),
        (((-1.2, 0.9), (0, 1.2)), ([-80, -60, -40, -20, 0], [66, 69, 72, 75, 78])),
        (((-0.02, 0.1), (0.3, 0.11)), ([0, 5, 10, 15], [5.8, 5.9, 6, 6.1, 6.2, 6.3])),
    ],
)
def test_degrees_are_few_and_round(bounds, degrees, variant):
    figure = plot.pndf(compared(bounds))
    figure.canvas.draw()
    axis = figure.axes[0]
    across, up = axis.child_axes
    for shown, expected, limits in (
        (across.get_xticks(), degrees[0], across.get_xlim()),
        (up.get_yticks(), degrees[1], up.get_ylim()),
    ):
        np.testing.assert_allclose(shown, expected, atol=1e-9)
        assert min(limits) <= min(shown) and max(shown) <= max(limits)
