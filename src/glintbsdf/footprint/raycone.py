"""Ray cones: the width of the bundle of rays that a traced ray represents.

A cone is described by two *differentials*, one per image axis: how far the neighbouring pixel's
ray is away (``dp_x``, ``dp_y``, world units, taken at the ray's origin) and how much its direction
differs (``dd_x``, ``dd_y``, radians, perpendicular to the ray). Its cross-section is an ellipse
that may be stretched and rotated, as a pixel's footprint behind a curved mirror is. At a hit it
spans a parallelogram on the tangent plane, and UV partials follow from that. At a bounce the
directions change by the surface's curvature and the change of medium, exactly to first order for
mirrors and smooth refraction, and are widened by the lobe that the direction was drawn from.

Sources: Igehy, "Tracing Ray Differentials", SIGGRAPH 1999 (transfer, reflection, refraction);
Suykens and Willems, "Path Differentials and Applications", EGWR 2001 (a sample of density p stands
for the domain 1/(N p)); Akenine-Möller et al., "Improved Shader and Texture Level of Detail Using
Ray Cones", JCGT 10(1), 2021 (a cone widened by rough surfaces).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.gaussian import finite_or_zero, project_along, tangent_to_uv

# A lobe spreads over the hemisphere at most: the pdf of an unlikely direction bounds nothing.
MAX_LOBE_SOLID_ANGLE = 2 * dr.pi


@dataclass
class RayCone:
    """Differentials of a ray for one step along the image's x and y axes (``mi.Vector3f`` each).

    Attributes:
        dp_x, dp_y: of the ray's origin, world units.
        dd_x, dd_y: of the ray's unit direction, radians.
    """

    dp_x: mi.Vector3f
    dp_y: mi.Vector3f
    dd_x: mi.Vector3f
    dd_y: mi.Vector3f

    @staticmethod
    def from_ray(ray: mi.RayDifferential3f) -> RayCone:
        """The cone of a sensor's ray; a cone of no width where the sensor gives no differentials.

        Mitsuba has already scaled the differentials by 1/√spp when an integrator receives them.
        """
        if not ray.has_differentials:
            return RayCone(*(dr.zeros(mi.Vector3f, dr.width(ray.d)) for _ in range(4)))
        return RayCone(
            dp_x=mi.Vector3f(ray.o_x - ray.o),
            dp_y=mi.Vector3f(ray.o_y - ray.o),
            dd_x=_across(ray.d, ray.d_x - ray.d),
            dd_y=_across(ray.d, ray.d_y - ray.d),
        )

    def at(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> RayCone:
        """The cone where its ray, of direction ``d``, hits a surface: ``dp`` in the tangent plane.

        Igehy's (1999) transfer. Where the ray grazes so closely that an offset is not finite, that
        offset is zero.
        """
        dp_x, dp_y = (
            finite_or_zero(project_along(d, si.n, dp + dd * si.t))
            for dp, dd in ((self.dp_x, self.dd_x), (self.dp_y, self.dd_y))
        )
        return RayCone(dp_x, dp_y, self.dd_x, self.dd_y)

    def uv_partials(self, si: mi.SurfaceInteraction3f) -> tuple[mi.Vector2f, mi.Vector2f]:
        """UV partials (``duv_dx``, ``duv_dy``) of a cone that :meth:`at` brought to ``si``."""
        return tuple(
            finite_or_zero(tangent_to_uv(si.dp_du, si.dp_dv, dp)) for dp in (self.dp_x, self.dp_y)
        )

    def turned_per_uv(self, si: mi.SurfaceInteraction3f) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Change of the direction towards the ray's origin over the surface at ``si``, per unit
        of u and of v: the cone's change per pixel, by the UV partials of a pixel that ``si`` has.

        Zero where these are degenerate.
        """
        a, b = si.duv_dx, si.duv_dy
        determinant = a.x * b.y - a.y * b.x
        known = dr.abs(determinant) > 1e-30
        inverse = dr.select(known, -dr.rcp(dr.select(known, determinant, 1)), 0)
        return (
            (self.dd_x * b.y - self.dd_y * a.y) * inverse,
            (self.dd_y * a.x - self.dd_x * b.x) * inverse,
        )

    def scattered(
        self,
        si: mi.SurfaceInteraction3f,
        d: mi.Vector3f,
        d_out: mi.Vector3f,
        eta: mi.Float,
        spread: mi.Float,
    ) -> RayCone:
        """The cone after the surface has turned direction ``d`` into ``d_out``.

        With h the normal at which a mirror or a smooth interface of relative index ``eta`` turns d
        into d', and μ > 0 a scalar, both laws read d' = d/η + μ h. Its differential is
        dd' = dd/η + μ dh + h dμ, and |d'| = 1 gives dμ = −(d'·dd/η + μ d'·dh)/(d'·h). The normal h
        turns along with the surface's: dh = ±dn, dn = dn_du du + dn_dv dv. These are Igehy's (1999)
        reflection and refraction in one form; a rough lobe is treated as its mirror, then widened
        by :meth:`widened`.

        Args:
            si: the interaction that the cone is :meth:`at`, with ``dn_du``, ``dn_dv`` filled in.
            d, d_out: unit directions of the rays before and after, both along the path.
            eta: relative index of refraction along the path, ``BSDFSample3f.eta`` (1: reflection).
            spread: width of the lobe in radians, see :func:`lobe_width`; 0 for delta lobes.
        """
        inv_eta = dr.rcp(eta)
        turn = d_out - d * inv_eta
        mu = dr.norm(turn)
        straight_on = mu < 1e-4  # a null interaction: no normal takes part
        h = dr.select(straight_on, si.sh_frame.n, turn / mu)
        mu = dr.select(straight_on, 0, mu)
        side = dr.sign(dr.dot(h, si.sh_frame.n))

        def turned(dp, dd):
            du, dv = tangent_to_uv(si.dp_du, si.dp_dv, dp)
            dd_straight = dd * inv_eta + (si.dn_du * du + si.dn_dv * dv) * (side * mu)
            return _across(d_out, dd_straight - h * (dr.dot(d_out, dd_straight) / dr.dot(d_out, h)))

        cone = RayCone(
            self.dp_x, self.dp_y, turned(self.dp_x, self.dd_x), turned(self.dp_y, self.dd_y)
        )
        return cone.widened(d_out, spread)

    def widened(self, d: mi.Vector3f, spread: mi.Float) -> RayCone:
        """The cone of direction ``d`` with ``spread`` radians added to the angle of each axis.

        The two added directions are perpendicular; of all such pairs they are the nearest to
        (``dp_x``, ``dp_y``). A lobe makes the cone diverge, so widths add, as they do for ray cones
        (Akenine-Möller et al. 2021).
        """
        x, y = _nearest_orthonormal(d, self.dp_x, self.dp_y)
        return RayCone(self.dp_x, self.dp_y, self.dd_x + x * spread, self.dd_y + y * spread)


def curved_interaction(pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.SurfaceInteraction3f:
    """The surface interaction of ``pi`` with all fields, the derivatives of its shading normal
    ``dn_du`` and ``dn_dv`` included.

    Mitsuba 3.9 reports these by barycentric coordinates when the shape is a mesh (and by UV for all
    other shapes, as the next release does for all). They are converted here, by the edges of the
    triangle. A mesh inside an instance counts as flat: its edges are known before the instance's
    transformation only.
    """
    if not hasattr(mi.RayFlags, "dNSdUV"):
        # Other releases have other flags than the stubs know.
        flags = mi.RayFlags.Default | mi.RayFlags.NormalPartials  # type: ignore[attr-defined]
        return pi.compute_surface_interaction(ray, flags)

    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV)
    is_mesh = si.shape.is_mesh()
    known = is_mesh & (si.instance == None)  # noqa: E711 (a comparison per lane)
    mesh = mi.MeshPtr(si.shape)
    p0, p1, p2 = (mesh.vertex_position(i, known) for i in mesh.face_indices(si.prim_index, known))
    duv1, duv2 = (tangent_to_uv(si.dp_du, si.dp_dv, edge) for edge in (p1 - p0, p2 - p0))
    inv_det = dr.rcp(duv1.x * duv2.y - duv1.y * duv2.x)
    inv_det = dr.select(known & dr.isfinite(inv_det), inv_det, 0)
    # Copies, as an attribute of an interaction is a view that changes with it
    dn_db1, dn_db2 = mi.Vector3f(si.dn_du), mi.Vector3f(si.dn_dv)
    si.dn_du = dr.select(is_mesh, (dn_db1 * duv2.y - dn_db2 * duv1.y) * inv_det, dn_db1)
    si.dn_dv = dr.select(is_mesh, (dn_db2 * duv1.x - dn_db1 * duv2.x) * inv_det, dn_db2)
    return si


def lobe_width(pdf: mi.Float, sample_count: int) -> mi.Float:
    """Width in radians of the part of a lobe that one of its samples represents.

    With N samples per pixel, a direction of density ``pdf`` (1/sr) represents the solid
    angle 1/(N pdf) (Suykens and Willems 2001), here a square of this area. N enters exactly as in
    the 1/√spp of the sensor's differentials, so that all footprints vanish together as N grows.
    """
    return dr.sqrt(dr.minimum(dr.rcp(pdf), MAX_LOBE_SOLID_ANGLE) / sample_count)


def _across(d: mi.Vector3f, v: mi.Vector3f) -> mi.Vector3f:
    """The part of ``v`` perpendicular to the unit vector ``d``; zero where it is not finite."""
    return finite_or_zero(v - d * dr.dot(d, v))


def _nearest_orthonormal(
    d: mi.Vector3f, a: mi.Vector3f, b: mi.Vector3f
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The orthonormal pair across ``d`` nearest to (``a``, ``b``): the polar factor of the 2×2
    matrix of their components; any pair where a and b vanish."""
    s, t = mi.coordinate_system(d)
    a, b = (mi.Vector2f(dr.dot(s, v), dr.dot(t, v)) for v in (a, b))
    # A pair of negative orientation is mirrored into a rotation and back.
    orientation = dr.sign(a.x * b.y - a.y * b.x)
    rotation = mi.Vector2f(a.x + orientation * b.y, a.y - orientation * b.x)
    length = dr.norm(rotation)
    rotation = dr.select(length > 0, rotation / length, mi.Vector2f(1, 0))
    return (
        s * rotation.x + t * rotation.y,
        (t * rotation.x - s * rotation.y) * orientation,
    )
