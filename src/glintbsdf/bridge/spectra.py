"""Conversion of colours to the variant's representation: colours, luminance or spectra."""

from __future__ import annotations

import mitsuba as mi


class ColorConversion:
    """Linear in the colour, and exact for white: equal components give equal spectra.

    Spectral variants mix the spectra that Mitsuba gives to pure red, green and blue, divided by
    their sum. Mitsuba's own conversion is smoother, but not linear, so that the mean of many
    spectra would not be the spectrum of the mean.
    """

    def __init__(self) -> None:
        if mi.is_spectral:
            self.primaries = [
                mi.load_dict({"type": "rgb", "value": [float(k == i) for k in range(3)]})
                for i in range(3)
            ]

    def eval(
        self, color: mi.Color3f, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """``color`` (linear RGB) in this variant's representation, at the wavelengths of ``si``."""
        if mi.is_monochromatic:
            return mi.UnpolarizedSpectrum(mi.luminance(color))
        if not mi.is_spectral:
            return mi.UnpolarizedSpectrum(color)
        red, green, blue = (primary.eval(si, active) for primary in self.primaries)
        mixed = color.x * red + color.y * green + color.z * blue
        return mixed / (red + green + blue)
