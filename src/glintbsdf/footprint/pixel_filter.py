"""A pixel's reconstruction filter, shared between footprints and the places of samples.

The value of a pixel is the image filtered by the film's reconstruction filter, of variance Σ along
each axis. A footprint of variance a Σ filters what it covers; what is left of the filter is drawn:
footprints lie about the pixel's centre as the filter itself would place them, contracted by
√(1 − a), so that they vary by (1 − a) Σ. Variances add, so for a Gaussian filter the two together
are the filter, whatever the share a; with any other filter they agree in mean and variance.

With footprints of Σ/N instead, as the usual scaling of ray differentials by 1/√N makes them, N
samples cover the pixel by chance, whatever N: the error hardly falls.

Source: Ernst, Stamminger and Greiner, "Filter Importance Sampling", IEEE Symposium on Interactive
Ray Tracing 2006.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.opaque import stored

#: Nodes of the table of a filter's profile.
NODES = 1025

#: Standard deviation (pixels) of a footprint whose UV partials are those of one pixel, by the
#: default of ``footprint_sigma``.
PIXEL_SIGMA = 0.5

#: Variance (pixels²) below which a filter has nothing to share.
LEAST_VARIANCE = 1e-3

#: Samples per pixel up to which footprints carry the whole filter, and the same for a filter that
#: drops to zero at its ends.
WHOLE_SAMPLES, WHOLE_SAMPLES_ABRUPT = 16, 4


def automatic_share(samples: int, abrupt: bool) -> float:
    """The share a of footprints where an image takes ``samples`` samples per pixel, in (0, 1].

    A footprint approximates its pixel. The squared error of this is about proportional to a², that
    of samples to (1 − a)/N. So up to :data:`WHOLE_SAMPLES` samples footprints carry the whole
    filter, and then their share falls as N^(−1/3). Footprints reach beyond the ends of an
    ``abrupt`` filter, see :class:`PixelFilter`. There the share falls sooner, as fast as the noise.
    """
    if abrupt:
        return min(1.0, WHOLE_SAMPLES_ABRUPT / samples)
    return min(1.0, WHOLE_SAMPLES / samples) ** (1 / 3)


class PixelFilter:
    """The profile of a separable reconstruction filter along one axis.

    Args:
        rfilter (mi.ReconstructionFilter): any filter of positive integral.

    Attributes:
        variance (float): ∫x² f dx / ∫f dx, pixels². Filters with negative lobes may have a variance
            of zero, or less.
        weight (float): ∫f dx / ∫|f| dx, the mean of the signs that :meth:`sample` returns for one
            axis.
        positive (bool): whether the profile is nowhere negative.
        abrupt (bool): whether the profile drops to zero at its ends, as a box does.
    """

    def __init__(self, rfilter: mi.ReconstructionFilter) -> None:
        radius = rfilter.radius()
        # A box drops to zero at its ends: we stay within them, by less than a sample would notice.
        x = np.linspace(-radius, radius, NODES) * (1 - 1e-6)
        profile = np.array(rfilter.eval(stored(mi.Float, x.astype(np.float32))), dtype=np.float64)
        step = x[1] - x[0]
        mass, total = (np.trapezoid(f, dx=step) for f in (profile, np.abs(profile)))
        self.variance = float(np.trapezoid(profile * x * x, dx=step) / mass)
        self.weight = float(mass / total)
        self.positive = bool(np.all(profile >= 0))
        self.abrupt = bool(abs(profile[-1]) > 0.1 * profile.max())
        self.rfilter = rfilter
        self.distribution = mi.ContinuousDistribution(
            mi.ScalarVector2f(-radius, radius),
            stored(mi.Float, np.abs(profile).astype(np.float32)),
        )

    def sample(self, sample: mi.Point2f) -> tuple[mi.Vector2f, mi.Float]:
        """Draw an offset from a pixel's centre (pixels) with density |f(x) f(y)|.

        Returns the offset, and the sign of f(x) f(y): the mean of a quantity under the filter is
        the mean of the sign times the quantity, divided by ``weight`` squared.
        """
        offset = mi.Vector2f(*(self.distribution.sample(s) for s in sample))
        if self.positive:
            return offset, mi.Float(1)
        x, y = (self.rfilter.eval(v) for v in offset)
        return offset, dr.sign(x * y)
