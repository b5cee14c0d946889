"""Colours of facets, each facet's own, drawn by a number in [0, 1) that belongs to it.

Source of the wheel: Zirr and Kaplanyan, "Real-time Rendering of Procedural Multiscale Materials",
I3D 2016, section 4.5.
"""

from __future__ import annotations

import colorsys

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.opaque import stored

#: Colours that stand for a variation about one.
VARIED = 4096


class Wheel:
    """Fully saturated colours of all hues, with components up to 2, so that their mean is white."""

    mean = (1.0, 1.0, 1.0)

    def pick(self, u: mi.Float) -> mi.Color3f:
        """The colour at the fraction ``u``, in [0, 1), of the way around the wheel."""
        hue = [6 * dr.abs(u - dr.floor(u + 0.5 - k / 3) - k / 3) for k in range(3)]
        return mi.Color3f([2 * dr.clip(2 - h, 0, 1) for h in hue])

    def __repr__(self) -> str:
        return "wheel"


class Palette:
    """The colours of an image, each as likely as any other.

    Args:
        colors: linear RGB values, an array N×3 (NumPy, float32).
    """

    def __init__(self, colors) -> None:
        self.count = len(colors)
        self.mean = tuple(float(x) for x in colors.mean(0))
        self.colors = stored(mi.Float, colors.ravel())

    def pick(self, u: mi.Float) -> mi.Color3f:
        """The colour at the fraction ``u``, in [0, 1), of the way through the image."""
        return dr.gather(mi.Color3f, self.colors, mi.UInt32(u * self.count))

    def __repr__(self) -> str:
        return f"palette of {self.count}"


def varied(color, hue: float, saturation: float, value: float) -> Palette:
    """Colours about one: hue, saturation and value of HSV vary evenly, each by itself.

    Args:
        color: linear RGB, three numbers in [0, 1].
        hue: greatest difference of hue, in turns of the wheel, in [0, 0.5].
        saturation, value: greatest relative differences, in [0, 1]. Results are cut at 1.
    """
    h, s, v = colorsys.rgb_to_hsv(*(float(x) for x in color))
    # Evenly strewn over three dimensions: multiples of three irrational numbers (Roberts 2018)
    root = 1.2207440846057596
    steps = np.arange(1, VARIED + 1)[:, None] * np.array([1 / root, 1 / root**2, 1 / root**3])
    differences = 2 * (steps % 1) - 1
    colors = [
        colorsys.hsv_to_rgb(
            (h + hue * a) % 1, min(s * (1 + saturation * b), 1), min(v * (1 + value * c), 1)
        )
        for a, b, c in differences
    ]
    return Palette(np.array(colors, np.float32))
