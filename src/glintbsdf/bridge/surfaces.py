"""The surfaces that a BSDF is on, and whether their UV coordinates fit its map.

A BSDF of Mitsuba does not know its shapes. Dr.Jit's registry does: it holds every shape of the
active variant, also those inside a ``shapegroup``, which ``scene.shapes()`` leaves out.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import ParameterError
from glintbsdf.maps.normalmap import NormalMap

#: A mesh has no orientation if more than this share of its area has the other one.
_MIXED = 0.1


def live_shapes() -> Iterator[mi.Shape]:
    """Every shape of the active variant that exists now."""

    def at(index: int) -> mi.Shape | None:
        return mi.ShapePtr(dr.reinterpret_array(mi.ShapePtr, mi.UInt32(index)))[0]

    # Dr.Jit raises an error beyond the last entry of the registry, if there has ever been a shape.
    # Otherwise all entries are empty, and so is an entry whose shape is gone.
    with contextlib.suppress(RuntimeError):
        if at(2**31) is None:
            return
    with contextlib.suppress(RuntimeError):
        for index in itertools.count(1):
            if (shape := at(index)) is not None:
                yield shape


def shapes_of(bsdf: mi.BSDF) -> list[mi.Shape]:
    """The shapes whose material is ``bsdf``, or contains it."""
    contains: dict[mi.BSDF, bool] = {}  # many shapes share one material
    found = []
    for shape in live_shapes():
        material = shape.bsdf()
        if material is None:
            continue
        if material not in contains:
            contains[material] = material is bsdf or _holds(material, bsdf)
        if contains[material]:
            found.append(shape)
    return found


def _holds(material: mi.Object, bsdf: mi.BSDF) -> bool:
    """Whether ``material`` contains ``bsdf`` at any depth, as its traversal shows."""
    look = _look_class(mi.variant())(bsdf)
    material.traverse(look)
    return look.found


@functools.cache
def _look_class(variant: str) -> type:
    """The class of the traversal in :func:`_holds`, for a variant.

    It is made once, and has no closure. A class is part of reference cycles. If each search made
    one with a closure, the class would keep the BSDF alive until Python's garbage collection, which
    may come while Dr.Jit records calls of that BSDF.
    """

    class Look(mi.TraversalCallback):
        def __init__(self, bsdf: mi.BSDF) -> None:
            super().__init__()
            self.bsdf, self.found = bsdf, False

        def put(self, name: str, value: object, flags: int, *rest: object) -> None:
            if isinstance(value, mi.BSDF) and not self.found:
                self.found = value is self.bsdf or _holds(value, self.bsdf)

    return Look


def require_uvs(owner: str, shapes: list[mi.Shape]) -> None:
    """Refuse meshes without UV coordinates under a glint BSDF.

    Mitsuba uses the barycentric coordinates of each triangle in place of missing UV coordinates, so
    every triangle would show the whole map.

    Raises:
        ParameterError: a mesh has no UV coordinates; the message names the plugin and the mesh, and
            says what to do.
    """
    for shape in shapes:
        buffers = mi.traverse(shape) if shape.is_mesh() else {}
        if "vertex_texcoords" in buffers and not len(buffers["vertex_texcoords"]):
            raise ParameterError(
                f'{owner}: the mesh "{shape.id() or shape.class_name()}" has no UV coordinates, by '
                "which its glint BSDF finds its place in the map: export the mesh with UVs (PLY: "
                "s, t or u, v; OBJ: vt), or use a shape of Mitsuba that has them"
            )


def require_tangents(owner: str, shapes: list[mi.Shape]) -> None:
    """Refuse curves under a BSDF whose footprints lie in space: they have no tangents across them.

    Raises:
        ParameterError: names the plugin and the shape, and says what to do.
    """
    for shape in shapes:
        if shape.shape_type() in (+mi.ShapeType.BSplineCurve, +mi.ShapeType.LinearCurve):
            raise ParameterError(
                f'{owner}: "space" must be uv on "{shape.id() or shape.class_name()}", a curve, '
                "whose surface has no frame of tangents (got object): use a mesh, or a shape of "
                "Mitsuba that has a surface"
            )


def uv_orientation(shape: mi.Shape) -> int:
    """1 if u, v and the normal of a surface are right-handed, −1 if they are left-handed, else 0.

    Mirrored UVs are left-handed, and so are the UVs of every OBJ file as Mitsuba loads it. Faces
    count by area. The result is 0 for meshes whose faces disagree, and for shapes without a
    parameterisation. A shape from the registry may have lost its class in Python, so the buffers of
    a mesh are read from its parameters.
    """
    buffers = mi.traverse(shape) if shape.is_mesh() else {}
    if "vertex_texcoords" not in buffers:  # a rectangle, a sphere, …
        try:
            si = shape.eval_parameterization(mi.Point2f([0.2, 0.5, 0.8], [0.3, 0.5, 0.6]))
        except RuntimeError:
            return 0
        signs = np.sign(np.array(dr.dot(dr.cross(si.dp_du, si.dp_dv), mi.Vector3f(si.sh_frame.n))))
        # The parameterisation of a rectangle ignores flip_normals, unlike its intersections.
        signs = -signs if shape.is_mesh() and shape.has_flipped_normals() else signs
        return int(signs[0]) if (signs == signs[0]).all() else 0
    if not len(buffers["vertex_texcoords"]):
        return 0
    faces = np.array(buffers["faces"]).reshape(-1, 3)
    faces = faces[:: max(1, len(faces) // 4096)]
    points = np.array(buffers["vertex_positions"], np.float64).reshape(-1, 3)[faces]
    uv = np.array(buffers["vertex_texcoords"], np.float64).reshape(-1, 2)[faces]
    edges, turns = points[:, 1:] - points[:, :1], uv[:, 1:] - uv[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    signs = np.sign(turns[:, 0, 0] * turns[:, 1, 1] - turns[:, 0, 1] * turns[:, 1, 0])
    if len(buffers["vertex_normals"]):  # a mirrored object keeps these, but its winding turns
        normals = np.array(buffers["vertex_normals"], np.float64).reshape(-1, 3)[faces].sum(axis=1)
        winding = np.cross(edges[:, 0], edges[:, 1])
        signs *= np.sign(np.einsum("ij,ij->i", winding, normals))
    share = float((area * signs).sum() / max(area.sum(), 1e-300))
    if abs(share) < 1 - 2 * _MIXED:
        return 0
    return int(np.sign(share)) * (-1 if shape.has_flipped_normals() else 1)


def doubt_of_green(
    normal_map: NormalMap, to_uv: mi.ScalarAffineTransform3f, shapes: list[mi.Shape]
) -> str:
    """A warning if the map's normals fit together on these shapes only with a reversed green.

    The second component of a normal points along v on right-handed UVs, and against v on
    left-handed ones, as the shading frame does; ``to_uv`` may mirror the map once more. The result
    is empty if the shapes disagree, or if the normals fit as they are.
    """
    orientations = {uv_orientation(shape) for shape in shapes}
    if orientations not in ({1}, {-1}):
        return ""
    matrix = to_uv.matrix
    mirrored = matrix[0, 0] * matrix[1, 1] < matrix[0, 1] * matrix[1, 0]
    return normal_map.doubt_of_green(orientations.pop() * (-1 if mirrored else 1))
