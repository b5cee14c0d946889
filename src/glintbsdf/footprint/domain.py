"""The part of a normal map that a scene uses, and the sizes of its footprints.

A :class:`Recorder` in a BSDF records what all queries of a rendering touch; its result is a
:class:`Domain`. P-NDFs with a domain build no more than it needs. A :class:`Gate` in a BSDF
then keeps all queries inside the domain, and reports whether any had to be replaced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import REACH, TexelKernel
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.maps.normalmap import MapShape

#: Sizes of footprints are recorded as logarithms, in this many steps per octave.
STEPS = 16

#: Margin that :meth:`Domain.widened` adds: texels on each side, and a factor on sizes. A survey of
#: some hundred thousand queries represents a rendering of some millions.
MARGIN_TEXELS, MARGIN_SIZE = 8, 1.25


@dataclass(frozen=True)
class Domain:
    """The part of a map that queries touch.

    Attributes:
        columns, rows (tuple[int, int]): first and last texel under any footprint. They are counted
            in the period of a map that repeats or mirrors in which the footprint has its centre:
            one across the border of the period reaches below 0, or beyond the last texel.
        smallest, largest (float): standard deviations of footprints, texels: the least along a
            minor axis, the greatest along a major one.
    """

    columns: tuple[int, int]
    rows: tuple[int, int]
    smallest: float
    largest: float

    @property
    def most_quads(self) -> float:
        """Bounds ``TexelKernel.touched_quads`` of any footprint within the domain."""
        return (2 * max(REACH.values()) * self.largest + 1) ** 2

    def widened(self) -> Domain:
        """The domain with a margin, for what a survey may have missed."""
        columns, rows = (
            (first - MARGIN_TEXELS, last + MARGIN_TEXELS)
            for first, last in (self.columns, self.rows)
        )
        return Domain(columns, rows, self.smallest / MARGIN_SIZE, self.largest * MARGIN_SIZE)


#: The domain of a map without queries.
NOTHING = Domain(columns=(0, -1), rows=(0, -1), smallest=0.0, largest=0.0)


# ------------------------------------------------------------------------------------------------
#  Queries
# ------------------------------------------------------------------------------------------------


class Extent(NamedTuple):
    """Texels that one query touches (``mi.Int``), and the footprint's standard deviations along
    its axes (``mi.Float``, texels)."""

    left: mi.Int
    right: mi.Int
    top: mi.Int
    bottom: mi.Int
    minor: mi.Float
    major: mi.Float


def extent(footprint: Footprint, shape: MapShape) -> Extent:
    """The extent of a footprint with the widest of all kernels."""
    kernel = TexelKernel("gaussian", footprint, shape.height, shape.width, shape.wrap_mode)
    mean = kernel.mean
    both = dr.square(kernel.sigma_u) + dr.square(kernel.sigma_v)
    return Extent(
        floor_int(mean.x - kernel.reach_u),
        floor_int(mean.x + kernel.reach_u) + 1,
        floor_int(mean.y - kernel.reach_v),
        floor_int(mean.y + kernel.reach_v) + 1,
        dr.sqrt(kernel.minor_variance),
        dr.sqrt(both - kernel.minor_variance),
    )


class Recorder:
    """Records what queries touch; ``footprint = recorder(footprint, active)`` in a BSDF.

    Args:
        shape (MapShape): shape of the map that is asked.
    """

    NEVER = -(1 << 30)

    def __init__(self, shape: MapShape) -> None:
        self.shape = shape
        self.largest = dr.full(mi.Int, self.NEVER, 6)
        dr.make_opaque(self.largest)

    def __call__(self, footprint: Footprint, active: mi.Bool) -> Footprint:
        """Note the footprint, and return it."""
        with dr.suspend_grad():
            e = extent(footprint, self.shape)
            minor, major = (STEPS * dr.log2(size) for size in (e.minor, e.major))
            noted = (-e.left, e.right, -e.top, e.bottom, -floor_int(minor), floor_int(major) + 1)
            for index, value in enumerate(noted):
                dr.scatter_reduce(
                    dr.ReduceOp.Max, self.largest, mi.Int(value), mi.UInt32(index), active
                )
        return footprint

    def found(self) -> Domain | None:
        """The domain of all queries so far; None if there was none."""
        left, right, top, bottom, minor, major = (int(x) for x in self.largest.numpy())
        if right == self.NEVER:
            return None
        return Domain((-left, right), (-top, bottom), 2 ** (-minor / STEPS), 2 ** (major / STEPS))


class Gate:
    """Lets through what lies within a domain; ``footprint = gate(footprint, active)`` in a BSDF.

    It replaces any other footprint by one that the estimator can answer, whatever the answer may
    be. The rendering is then worth nothing, and :meth:`missed` tells so.

    Args:
        shape (MapShape): shape of the map that is asked.
        domain (Domain): what may be asked.
    """

    def __init__(self, shape: MapShape, domain: Domain) -> None:
        self.shape, self.domain = shape, domain
        self.misses = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self.misses)

    def __call__(self, footprint: Footprint, active: mi.Bool) -> Footprint:
        """The footprint, or another."""
        domain = self.domain
        with dr.suspend_grad():
            e = extent(footprint, self.shape)
            inside = (
                (e.left >= domain.columns[0])
                & (e.right <= domain.columns[1])
                & (e.top >= domain.rows[0])
                & (e.bottom <= domain.rows[1])
                & (e.minor >= domain.smallest)
                & (e.major <= domain.largest)
            )
            dr.scatter(self.misses, mi.UInt32(1), mi.UInt32(0), active & ~inside)
        # The smallest footprint, in the middle of the domain, fits in wherever there was any.
        width, height = self.shape.width, self.shape.height
        middle = mi.Point2f(
            (sum(domain.columns) + 1) / (2 * width), (sum(domain.rows) + 1) / (2 * height)
        )
        return Footprint(
            dr.select(inside, footprint.uv, middle),
            dr.select(inside, footprint.du, mi.Vector2f(domain.smallest / width, 0)),
            dr.select(inside, footprint.dv, mi.Vector2f(0, domain.smallest / height)),
        )

    def missed(self) -> bool:
        """Whether anything else has been asked for."""
        return bool(self.misses[0])
