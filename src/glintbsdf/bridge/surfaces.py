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

#: A mesh whose faces disagree more than this, by area, has no orientation.
_MIXED = 0.1


def live_shapes() -> Iterator[mi.Shape]:
    """Every shape of the active variant that is alive."""

    def at(index: int) -> mi.Shape | None:
        return mi.ShapePtr(dr.reinterpret_array(mi.ShapePtr, mi.UInt32(index)))[0]

    # Beyond the last place Dr.Jit raises an error, if there ever was a shape; else all are empty,
    # as is a place that is free again.
    with contextlib.suppress(RuntimeError):
        if at(2**31) is None:
            return
    with contextlib.suppress(RuntimeError):
        for index in itertools.count(1):
            if (shape := at(index)) is not None:
                yield shape


def shapes_of(bsdf: mi.BSDF) -> list[mi.Shape]:
    """The shapes whose material is ``bsdf``, or is made of it among others."""
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
    """Whether ``material`` hands ``bsdf`` on in its traversal, at any depth."""
    look = _look_class(mi.variant())(bsdf)
    material.traverse(look)
    return look.found


@functools.cache
def _look_class(variant: str) -> type:
    """The traversal of :func:`_holds`, in a variant.

    It is made once, and holds nothing by a closure. A class is part of reference cycles: one that
    was made for each search would keep its BSDF alive until Python's collector comes, perhaps in
    the middle of a recording that still calls it.
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

    Mitsuba gives such a mesh the barycentric coordinates of each triangle in their place, so that
    every triangle would show the whole map.

    Raises:
        ParameterError: names the plugin and the mesh, and says what to do.
    """
    for shape in shapes:
        buffers = mi.traverse(shape) if shape.is_mesh() else {}
        if "vertex_texcoords" in buffers and not len(buffers["vertex_texcoords"]):
            raise ParameterError(
                f'{owner}: the mesh "{shape.id() or shape.class_name()}" has no UV coordinates, by '
                "which its glint BSDF finds its place in the map: export the mesh with UVs (PLY: "
                "s, t or u, v; OBJ: vt), or use a shape of Mitsuba that has them"
            )


def uv_orientation(shape: mi.Shape) -> int:
    """1 where u, v and the normal of a surface are right-handed, -1 where left-handed, else 0.

    Mirrored UVs are left-handed, and so are the UVs of every OBJ file as Mitsuba loads it. Faces
    count by area; meshes whose faces disagree give 0, as do shapes that cannot tell. The registry
    knows a shape only by the class that Python has first seen it as, so a mesh is asked by its
    parameters.
    """
    buffers = mi.traverse(shape) if shape.is_mesh() else {}
    if "vertex_texcoords" not in buffers:  # a rectangle, a sphere, …
        try:
            si = shape.eval_parameterization(mi.Point2f([0.2, 0.5, 0.8], [0.3, 0.5, 0.6]))
        except RuntimeError:
            return 0
        signs = np.sign(np.array(dr.dot(dr.cross(si.dp_du, si.dp_dv), mi.Vector3f(si.sh_frame.n))))
        # A rectangle's own parameterisation, unlike its intersections, knows of no flip.
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
    if len(buffers["vertex_normals"]):  # which a mirrored object keeps, as its winding turns
        normals = np.array(buffers["vertex_normals"], np.float64).reshape(-1, 3)[faces].sum(axis=1)
        winding = np.cross(edges[:, 0], edges[:, 1])
        signs *= np.sign(np.einsum("ij,ij->i", winding, normals))
    share = float((area * signs).sum() / max(area.sum(), 1e-300))
    if abs(share) < 1 - 2 * _MIXED:
        return 0
    return int(np.sign(share)) * (-1 if shape.has_flipped_normals() else 1)


def doubt_of_green(
    normal_map: NormalMap | None, to_uv: mi.ScalarAffineTransform3f, shapes: list[mi.Shape]
) -> str:
    """A sentence where the normals would fit together on these shapes if green were reversed.

    A normal's second component points along v on right-handed UVs and against it on left-handed
    ones, as the shading frame does; ``to_uv`` may mirror the map once more. The sentence is empty
    where ``flip_y`` was given, where the shapes disagree, and where nothing speaks for the reverse.
    """
    if normal_map is None or normal_map.green_is_given:
        return ""
    orientations = {uv_orientation(shape) for shape in shapes}
    if orientations not in ({1}, {-1}):
        return ""
    matrix = to_uv.matrix
    mirrored = matrix[0, 0] * matrix[1, 1] < matrix[0, 1] * matrix[1, 0]
    return normal_map.doubt_of_green(orientations.pop() * (-1 if mirrored else 1))
