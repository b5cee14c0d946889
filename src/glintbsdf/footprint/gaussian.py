"""The footprint: the Gaussian, in UV, over which a glint BSDF averages its normals.

A pixel sees a patch of the surface, not a point. The patch is described by two vectors ``du`` and
``dv`` in UV space, conjugate semi-axes of its one-sigma ellipse: the covariance is
``du duᵀ + dv dvᵀ``, a full 2×2 matrix that may be stretched and rotated in any way. Nothing here
reduces it to axis-aligned extents.

Sources: Igehy, "Tracing Ray Differentials", SIGGRAPH 1999 (UV partials of a pixel); Yan et al.,
"Position-Normal Distributions for Efficient Rendering of Specular Microstructure", SIGGRAPH 2016,
section 3 (the Gaussian footprint).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from typing import Any

# Sine of the angle between dp_du and dp_dv below which a parameterisation counts as degenerate. The
# rounding noise of the float32 cross product is about 1e-7: the inverse keeps two digits here.
MIN_SINE = 1e-5


class Footprint:
    """A Gaussian in UV space.

    Attributes:
        uv: mean, ``mi.Point2f``, UV units.
        du, dv: ``mi.Vector2f``, UV units; the covariance is ``du duᵀ + dv dvᵀ``. Any two vectors
            with this sum describe the same footprint: their order, signs and rotation carry no
            meaning. Both may be zero: the footprint is then a point.
    """

    def __init__(self, uv: mi.Point2f, du: mi.Vector2f, dv: mi.Vector2f) -> None:
        self.uv = mi.Point2f(uv)
        self.du = mi.Vector2f(du)
        self.dv = mi.Vector2f(dv)

    def __repr__(self) -> str:
        vectors = {"uv": mi.Vector2f(self.uv), "du": self.du, "dv": self.dv}
        count = max(dr.width(v) for v in vectors.values())
        if count != 1 or dr.flag(dr.JitFlag.SymbolicScope):  # while recording there are no numbers
            return f"Footprint({count} of them)"
        told = (f"{name}=({v.x[0]:.4g}, {v.y[0]:.4g})" for name, v in vectors.items())
        return f"Footprint({', '.join(told)})"

    @classmethod
    def isotropic(cls, uv: mi.Point2f, sigma_uv: float | mi.Float) -> Footprint:
        """A round footprint with standard deviation ``sigma_uv`` (UV units, ≥ 0) in each axis."""
        return cls(uv, mi.Vector2f(sigma_uv, 0), mi.Vector2f(0, sigma_uv))

    @classmethod
    def from_interaction(
        cls,
        si: mi.SurfaceInteraction3f,
        footprint_sigma: float | mi.Float = 0.5,
        pixel_spread: float | mi.Float = 0.0,
    ) -> Footprint:
        """The footprint of a pixel at a surface interaction.

        Per lane, the first of these that is not zero:

        1. the UV partials ``si.duv_dx``, ``si.duv_dy`` (set by ``glint_path``);
        2. ``si.footprint``, where this version of Mitsuba has it: a 2×2 matrix whose columns are
           conjugate diameters, one pixel across, in UV;
        3. the cone of ``pixel_spread`` radians per pixel over the distance ``si.t``, see
           :func:`cone_partials`.

        Partials that are not finite count as zero. The covariance is
        ``footprint_sigma² (duv_dx duv_dxᵀ + duv_dy duv_dyᵀ)``, so the default of 0.5 puts the
        one-sigma ellipse on the pixel's edges.

        Where ``pixel_spread`` is a plain 0 (a Python number or a Dr.Jit literal) no code for the
        cone is generated; likewise none for the partials in stock integrators, whose partials are
        literal zeros. Derivatives flow through ``footprint_sigma``, ``pixel_spread`` and ``si``.
        """
        candidates = [(si.duv_dx, si.duv_dy)]
        if hasattr(si, "footprint"):
            diameters = si.footprint
            candidates.append(
                tuple(mi.Vector2f(diameters[0, k], diameters[1, k]) for k in range(2))
            )
        if not is_literal_zero(pixel_spread):
            candidates.append(cone_partials(si, si.t * pixel_spread))

        dx, dy = mi.Vector2f(0), mi.Vector2f(0)
        for candidate_dx, candidate_dy in reversed(candidates):
            candidate_dx, candidate_dy = finite_or_zero(candidate_dx), finite_or_zero(candidate_dy)
            present = dr.any((candidate_dx != 0) | (candidate_dy != 0))
            dx = dr.select(present, candidate_dx, dx)
            dy = dr.select(present, candidate_dy, dy)
        return cls(si.uv, dx * footprint_sigma, dy * footprint_sigma)

    def transformed(self, to_uv: Any) -> Footprint:
        """The footprint after a texture's ``to_uv``, an affine transform of the UV plane.

        ``to_uv`` is a 3×3 transform, e.g. ``mi.ScalarAffineTransform3f`` (``.extract()`` of the 4×4
        one that a scene file gives). The mean moves as a point, the axes as vectors.
        """
        to_uv = mi.AffineTransform3f(to_uv)
        return Footprint(to_uv @ self.uv, to_uv @ self.du, to_uv @ self.dv)

    def among_details(self, growth: mi.Float) -> Footprint:
        """The same footprint, with the derivative of a pattern of details that grows denser.

        Drawing more details has no derivative. But on average over places, a random pattern whose
        density grows is one that shrinks by √``growth``, and what a footprint shows of it depends
        on their relative size alone: so it is the footprint that grows here, where it is. Averaged
        over places, the derivative of anything computed from D of one footprint is right: of its
        mean, its contrast and so on.

        ``growth``: the density over its own value, which is 1 with a derivative.
        """
        if not dr.grad_enabled(growth):
            return self
        stretch = dr.sqrt(growth)
        return Footprint(self.uv, self.du * stretch, self.dv * stretch)

    def is_known_to_be_zero(self) -> bool:
        """Whether it is certain while a kernel is being recorded that this footprint is a point.

        True for literal zeros only: what a stock integrator (literal zero partials) and a literal
        ``pixel_spread`` of 0 give. Reads no device memory, so it may be called anywhere and costs
        nothing. False says nothing: lanes may still turn out to be zero.
        """
        return all(is_literal_zero(x) for axis in (self.du, self.dv) for x in axis)


def is_literal_zero(value: float | mi.Float) -> bool:
    """Whether ``value`` is a Python zero or a Dr.Jit literal zero; never evaluates anything."""
    if isinstance(value, int | float):
        return value == 0
    return value.state == dr.VarState.Literal and not dr.grad_enabled(value) and value[0] == 0


Vector = TypeVar("Vector", "mi.Vector2f", "mi.Vector3f")


def finite_or_zero(v: Vector) -> Vector:
    """``v``, or the zero vector in lanes where a component is infinite or NaN."""
    finite = mi.Bool(dr.all(dr.isfinite(v)))
    return dr.select(finite, v, type(v)(0))


def cone_partials(si: mi.SurfaceInteraction3f, width: mi.Float) -> tuple[mi.Vector2f, mi.Vector2f]:
    """UV partials of a cone of rays of diameter ``width`` (world units) around ``si.wi``.

    Two orthonormal vectors x, y across the viewing direction ω are carried along ω onto the tangent
    plane with normal n, ``x' = x − ω (n·x)/(n·ω)``, and expressed in ``dp_du``, ``dp_dv``. The
    ellipse is ``width`` wide across the plane of incidence and ``width/|n·ω|`` along it. Only the
    tilt of ω counts, so a ``twosided`` wrapper, which mirrors ``si.wi``, changes nothing.

    Returns two ``mi.Vector2f``; at exactly grazing incidence they are not finite.
    """
    omega = si.to_world(si.wi)
    return tuple(
        tangent_to_uv(si.dp_du, si.dp_dv, width * project_along(omega, si.n, axis))
        for axis in mi.coordinate_system(omega)
    )


def project_along(d: mi.Vector3f, n: mi.Vector3f, v: mi.Vector3f) -> mi.Vector3f:
    """``v`` moved along direction ``d`` into the plane through the origin with normal ``n``.

    The sign of ``d`` does not matter. The result is not finite if ``d`` is in the plane.
    """
    return v - d * (dr.dot(n, v) / dr.dot(n, d))


def tangent_to_uv(dp_du: mi.Vector3f, dp_dv: mi.Vector3f, offset: mi.Vector3f) -> mi.Vector2f:
    """The UV offset whose image under ``[dp_du dp_dv]`` is nearest to the world-space ``offset``.

    The least-squares inverse, by cross products of unit vectors rather than by the Gram
    determinant, which loses half the digits of a slanted parameterisation. Zero where ``dp_du`` and
    ``dp_dv`` are parallel (within ``MIN_SINE``) or one of them vanishes.
    """
    length_u, length_v = dr.norm(dp_du), dr.norm(dp_dv)
    unit_u, unit_v = dp_du / length_u, dp_dv / length_v
    normal = dr.cross(unit_u, unit_v)
    squared_sine = dr.squared_norm(normal)
    scaled = normal / squared_sine
    uv = mi.Vector2f(
        dr.dot(dr.cross(offset, unit_v), scaled) / length_u,
        dr.dot(dr.cross(unit_u, offset), scaled) / length_v,
    )
    # The comparison is false for NaN, so a vanishing partial derivative ends here as well.
    return dr.select(squared_sine > MIN_SINE**2, uv, mi.Vector2f(0))
