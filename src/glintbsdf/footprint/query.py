"""A query: all inputs of a P-NDF, except the normal, in one evaluation of a glint BSDF.

The BSDF's base class makes one query per evaluation and passes it to the density, the sampler and
the masking. All of them share its data, and quantities that they derive from it.

**The footprint** is the part of the map under the pixel.

**The turn** H of the half vector. Over a footprint the half vector is not constant: the surface is
curved, and the camera and the light are near. To first order its projection is
s(u) = s₀ + H (u − u₀). The P-NDF is then ``∫ k(u) δ(n(u) − s(u)) du``, that of the field
n(u) − H (u − u₀): every Jacobian J of the map becomes J − H.

**The spread** Σ in normal space. Under a light of some extent the half vector covers a region
around s₀. The P-NDF is averaged over a uniform ellipse of this covariance, as a round light is one.
A method may take a Gaussian of this covariance instead.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import mitsuba as mi

from glintbsdf.footprint.gaussian import Footprint, tangent_to_uv
from glintbsdf.footprint.kernels import SIGMA_MIN, TexelKernel

T = TypeVar("T")


@dataclass(frozen=True)
class Place:
    """Where a query is in space, for methods that need no UV coordinates.

    Attributes:
        position (mi.Point3f): the centre of the footprint.
        dp_du, dp_dv (mi.Vector3f): change of the position per unit of u and of v.
    """

    position: mi.Point3f
    dp_du: mi.Vector3f
    dp_dv: mi.Vector3f

    def tangent(self, v: mi.Vector2f) -> mi.Vector3f:
        """A vector of the UV plane, on the surface."""
        return self.dp_du * v.x + self.dp_dv * v.y

    def in_uv(self, offset: mi.Vector3f) -> mi.Vector2f:
        """The vector of the UV plane that is nearest to ``offset`` on the surface."""
        return tangent_to_uv(self.dp_du, self.dp_dv, offset)


class Query:
    """All inputs of a P-NDF except the normal.

    Args:
        footprint (Footprint): mean and axes in the UV space of the map.
        turn (mi.Matrix2f): H = ∂s/∂u of the half vector's projection, per unit of UV; None if
            the half vector is constant.
        spread: vectors v (``mi.Vector2f``) whose products v vᵀ add up to the covariance Σ of
            projected normals over which D is averaged; none for no average.
        parameters: values, by name, of the P-NDF's parameters that have a
            texture, at the surface point.
        place (Place): position of the footprint in space; None if no method needs it.
        shift (mi.Vector2f): what the centre of the spread differs by from the projected normal that
            is asked for; None for no difference.
    """

    def __init__(
        self,
        footprint: Footprint,
        turn: mi.Matrix2f | None = None,
        spread: tuple[mi.Vector2f, ...] = (),
        parameters: Mapping[str, mi.Float] | None = None,
        place: Place | None = None,
        shift: mi.Vector2f | None = None,
    ) -> None:
        self.footprint, self.turn, self.spread = footprint, turn, tuple(spread)
        self.parameters, self.place, self.shift = dict(parameters or {}), place, shift
        self._derived: dict[Hashable, object] = {}

    def __repr__(self) -> str:
        names = [name for name in ("turn", "place") if getattr(self, name) is not None]
        names += [*["spread"] * bool(self.spread), *self.parameters]
        return f"Query({', '.join([repr(self.footprint), *names])})"

    @staticmethod
    def of(question: Query | Footprint) -> Query:
        """A query as it is, or the plain query of a footprint."""
        return question if isinstance(question, Query) else Query(question)

    def at(self, footprint: Footprint) -> Query:
        """The same query with another footprint."""
        return Query(footprint, self.turn, self.spread, self.parameters, self.place, self.shift)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result of ``make()``, which is called on first use only.

        ``key`` must contain all that ``make`` depends on besides the query. The result is shared
        and must not be changed. Do not call this inside the body of a recorded loop or branch, as
        results from there do not exist outside.
        """
        if key not in self._derived:
            self._derived[key] = make()
        return self._derived[key]  # type: ignore[return-value]

    def texel_kernel(
        self,
        kernel: str,
        height: int,
        width: int,
        wrap_mode: str,
        added: tuple[float, float] = (SIGMA_MIN**2, SIGMA_MIN**2),
    ) -> TexelKernel:
        """The footprint's kernel on a map of this size; see :class:`~.TexelKernel`."""
        return self.once(
            ("kernel", kernel, height, width, wrap_mode, added),
            lambda: TexelKernel(kernel, self.footprint, height, width, wrap_mode, added),
        )
