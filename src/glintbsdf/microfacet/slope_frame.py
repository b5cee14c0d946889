r"""From the frame of a height map to the shading frame: the facets of the displaced surface.

A height map gives slopes of texels over texels, σ = ∂h/∂x, x the place on the map in texels. The
surface that it displaces, p + ℓ h n with ℓ the size of a texel on the surface, has other slopes, as
texels lie on it stretched, rotated or mirrored: as Mitsuba's ``bumpmap`` has it, the partial
derivatives become ∂p/∂u + n (ℓ ∂h/∂u − n·∂p/∂u), and likewise for v. With

    J   2 × 2: ∂p/∂u and ∂p/∂v as columns, in the shading frame's s and t;
    T   2 × 2: texels per UV, diag(width, height) times the linear part of ``to_uv``;
    K = (T J⁻¹)ᵀ, whose rows say how x changes along s and along t, transposed,

the gradient of ℓ h along s and t is g = ℓ K σ. A texel's size is the side of a square of its area,
ℓ = |det K|^(−1/2), so

    g = M σ,   M = K / √|det K|,   |det M| = 1:

a rotation where UVs are conformal, with a reflection where they are left-handed. From this follows,
with a = m_xy/m_z the (negative) slope of a facet's unit normal m and primes for the map's frame:

* normals: a = M a′, m = (M a′, 1)/|…|;
* densities over the disk of projected normals: those over slopes are equal, |det M| being 1, and
  D = P(a)/m_z⁴ (Walter et al. 2007), so D(m) = D′(m′) (m′_z/m_z)⁴. A sampler draws m′;
* directions: ω·m/m_z = ω_z + ω_xy·M a′, so ω′ ∝ (Mᵀ ω_xy, ω_z) sees of every facet what ω sees.
  Projected areas P are those of the vector (Mᵀ ω_xy, ω_z), unnormalised; ratios of two of them,
  as P/ω_z, Λ and the share of a facet among those visible, are simply those of ω′;
* small differences of facets that lie nearly flat: dm′ = M⁻¹ dm.

Where UVs are degenerate M is the identity.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.gaussian import MIN_SINE


class SlopeFrame:
    """The linear map M between slopes of a height map and of the surface that it displaces.

    Attributes:
        matrix (mi.Matrix2f): M, with |det M| = 1.
        inverse (mi.Matrix2f): M⁻¹.
    """

    def __init__(self, matrix: mi.Matrix2f) -> None:
        self.matrix = matrix
        determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        # The determinant is 1 or −1, except for rounding.
        self.inverse = mi.Matrix2f(
            [[matrix[1, 1], -matrix[0, 1]], [-matrix[1, 0], matrix[0, 0]]]
        ) * dr.sign(determinant)

    @classmethod
    def from_interaction(
        cls,
        si: mi.SurfaceInteraction3f,
        to_uv: mi.ScalarAffineTransform3f,
        width: int,
        height: int,
        mirrored: bool = False,
    ) -> SlopeFrame:
        """M at a surface interaction, for a map of ``width`` × ``height`` texels.

        ``mirrored``: the map's copies beyond its border are mirrored, and so are their slopes. A
        footprint over a border is taken to be on the side of its centre.
        """
        s, t = si.sh_frame.s, si.sh_frame.t
        j_su, j_sv = dr.dot(si.dp_du, s), dr.dot(si.dp_dv, s)
        j_tu, j_tv = dr.dot(si.dp_du, t), dr.dot(si.dp_dv, t)
        # Scaled to unit columns first: UVs of any size, and none that are parallel.
        length_u = dr.sqrt(j_su * j_su + j_tu * j_tu)
        length_v = dr.sqrt(j_sv * j_sv + j_tv * j_tv)
        sine = (j_su * j_tv - j_sv * j_tu) / (length_u * length_v)
        known = dr.abs(sine) > MIN_SINE  # false for NaN as well
        texels = mi.AffineTransform3f(to_uv).matrix
        w, h = dr.opaque(mi.Float, width), dr.opaque(mi.Float, height)
        if mirrored:
            place = mi.AffineTransform3f(to_uv) @ si.uv
            w = w * _parity(place.x)
            h = h * _parity(place.y)
        # J⁻¹ without the factor 1/det J, whose magnitude the normalisation removes.
        # Rows of Jᵀ's adjugate: (∂u/∂s, ∂u/∂t) and (∂v/∂s, ∂v/∂t).
        sign = dr.sign(sine)
        u_s, u_t = j_tv * sign, -j_sv * sign
        v_s, v_t = -j_tu * sign, j_su * sign
        x_s, x_t = (w * (texels[0, 0] * u + texels[0, 1] * v) for u, v in ((u_s, v_s), (u_t, v_t)))
        y_s, y_t = (h * (texels[1, 0] * u + texels[1, 1] * v) for u, v in ((u_s, v_s), (u_t, v_t)))
        # Away from overflow, as texels may be of any size.
        largest = dr.maximum(
            dr.maximum(dr.abs(x_s), dr.abs(x_t)), dr.maximum(dr.abs(y_s), dr.abs(y_t))
        )
        x_s, x_t, y_s, y_t = (value / largest for value in (x_s, x_t, y_s, y_t))
        scale = dr.rsqrt(dr.abs(x_s * y_t - x_t * y_s))
        known &= dr.isfinite(scale)
        return cls(
            mi.Matrix2f(
                [
                    [dr.select(known, x_s * scale, 1), dr.select(known, y_s * scale, 0)],
                    [dr.select(known, x_t * scale, 0), dr.select(known, y_t * scale, 1)],
                ]
            )
        )

    def normal_to_map(self, m: mi.Vector3f) -> mi.Vector3f:
        """A unit normal of the shading frame in the map's; ``m_z`` > 0."""
        xy = self.inverse @ mi.Vector2f(m.x, m.y)
        return dr.normalize(mi.Vector3f(xy.x, xy.y, m.z))

    def normal_from_map(self, m: mi.Vector3f) -> mi.Vector3f:
        """A unit normal of the map's frame in the shading frame."""
        xy = self.matrix @ mi.Vector2f(m.x, m.y)
        return dr.normalize(mi.Vector3f(xy.x, xy.y, m.z))

    def direction_to_map(self, w: mi.Vector3f) -> mi.Vector3f:
        """The unit direction that sees of every facet in the map's frame what ``w`` sees."""
        m = self.matrix
        x = dr.fma(m[0, 0], w.x, m[1, 0] * w.y)
        y = dr.fma(m[0, 1], w.x, m[1, 1] * w.y)
        return dr.normalize(mi.Vector3f(x, y, w.z))

    @staticmethod
    def density_ratio(m: mi.Vector3f, of_map: mi.Vector3f) -> mi.Float:
        """D(m)/D′(m′) of one normal in both frames."""
        ratio = of_map.z / m.z
        return dr.select(m.z > 0, dr.square(dr.square(ratio)), 0)


def _parity(x: mi.Float) -> mi.Float:
    """1 where ⌊x⌋ is even, −1 where it is odd."""
    half = 0.5 * dr.floor(x)
    return dr.select(half == dr.floor(half), 1, mi.Float(-1))
