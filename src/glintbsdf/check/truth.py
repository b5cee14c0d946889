"""The truth by brute force: what a scene with a normal map looks like, without any P-NDF.

Mitsuba's own ``normalmap`` around ``roughconductor`` of tiny roughness turns every point of the map
into a mirror. Pixels average over what they see by sampling alone, so images need thousands of
samples per pixel, and no footprint, structure or estimator of this package can be at fault.

One thing differs from a glint BSDF by definition. A bumped mirror reflects all light that meets it,
while a microsurface without masking shows its facets by the area they turn to the viewer, as
``w·m / (m_z w_z)``. Both agree at normal incidence. Elsewhere their means agree with masking, or to
first order in the slopes where these average to zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.maps.normalmap import NormalMap

#: Roughness of the mirrors. In half vectors it is a tenth of the radius of the sun's disk.
ALPHA = 2e-4


def mirrors(
    normal_map: NormalMap,
    subdivisions: int = 3,
    alpha: float = ALPHA,
    to_uv: object = None,
    **conductor: object,
) -> dict:
    """The dictionary of stock BSDFs that show a map by brute force; for ``mi.load_dict``.

    Between texel centres a glint BSDF's normals are linear over triangles, a ``bitmap`` texture's
    bilinear. The map is therefore refined by ``subdivisions``, an odd number so that texel centres
    stay samples: exact there, and at (``subdivisions`` − 1) points between any two.

    Args:
        alpha: roughness of ``roughconductor``.
        to_uv: transform of the UV coordinates, as for a glint BSDF.
        conductor: further parameters of ``roughconductor``, such as ``material``.
    """
    check(
        subdivisions >= 1 and subdivisions % 2 == 1,
        "mirrors",
        "subdivisions",
        "an odd number ≥ 1",
        subdivisions,
    )
    s = refined(normal_map, subdivisions)
    z = np.sqrt(1 - (s.astype(np.float64) ** 2).sum(axis=2, keepdims=True)).astype(np.float32)
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.concatenate([s, z], axis=2) * 0.5 + 0.5),
        "raw": True,
        "wrap_mode": normal_map.wrap_mode,
    }
    if to_uv is not None:
        texture["to_uv"] = to_uv
    return {
        "type": "normalmap",
        "normalmap": texture,
        # Neither of these is part of the mirrors' geometry.
        "flip_invalid_normals": False,
        "use_shadowing_function": False,
        "nested": {"type": "roughconductor", "alpha": alpha, **conductor},
    }


def refined(normal_map: NormalMap, subdivisions: int) -> np.ndarray:
    """Projected normals (float32) of the mesh of triangles at ``subdivisions`` points per texel."""
    first = (subdivisions - 1) // 2
    axes = [
        (np.arange(n * subdivisions) - first) / subdivisions
        for n in (normal_map.height, normal_map.width)
    ]
    whole = [np.floor(axis).astype(int) for axis in axes]
    t, u = np.ix_(*(axis - corner for axis, corner in zip(axes, whole, strict=True)))
    (top, left), mode = whole, normal_map.wrap_mode

    def vertex(i: int, j: int) -> np.ndarray:
        return normal_map.normals[
            np.ix_(
                wrapped(top + i, normal_map.height, mode), wrapped(left + j, normal_map.width, mode)
            )
        ]

    n0, n1, n2, n3 = (vertex(i, j) for i in (0, 1) for j in (0, 1))
    t, u = t[..., None].astype(np.float32), u[..., None].astype(np.float32)
    upper = n0 + u * (n1 - n0) + t * (n2 - n0)
    lower = n3 + (1 - u) * (n2 - n3) + (1 - t) * (n1 - n3)
    return np.where(u + t <= 1, upper, lower)


def wrapped(index: np.ndarray, count: int, wrap_mode: str) -> np.ndarray:
    """The texel that stands at any whole-numbered index."""
    if wrap_mode == "clamp":
        return np.clip(index, 0, count - 1)
    if wrap_mode == "mirror":
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return index % count


def slope_moments(
    normal_map: NormalMap, uv: np.ndarray, axes: np.ndarray, k: int = 9
) -> np.ndarray:
    """Means, mean squares and mean products of slopes (N, 5: x, y, x², y², xy) of the map's mesh.

    They are weighed by Gaussian footprints: ``uv`` (N, 2) are the places, ``axes`` (N, 2, 2) the
    axes du, dv in columns, texels. The sums take k² points per texel, k an odd number,
    out to 4 standard deviations. Where the slope goes from 0 to another value within a texel, as at
    a scratch, k points find its mean square too small by 1/(4k²): 3 points would be wrong by 3 %.
    """
    fine, mode = refined(normal_map, k), normal_map.wrap_mode
    height, width = k * normal_map.height, k * normal_map.width
    result = []
    for place, axis in zip(uv, axes, strict=True):
        covariance = axis @ axis.T
        extent = np.ceil(4 * np.sqrt(np.diag(covariance))).astype(int)
        centre = np.asarray(place) * [normal_map.width, normal_map.height]  # in texels' edges
        corner = np.floor(centre).astype(int) - extent
        column, row = (
            np.arange(k * c, k * (c + 2 * e + 1)) for c, e in zip(corner, extent, strict=True)
        )
        offset = np.stack(np.meshgrid(*((x + 0.5) / k for x in (column, row))), -1) - centre
        inverse = np.linalg.inv(covariance)
        weight = np.exp(-0.5 * np.einsum("...i,ij,...j", offset, inverse, offset))
        if mode == "clamp":
            # Beyond the border the border's texel goes on, from its centre.
            row = np.clip(row, k // 2, height - 1 - k // 2)
            column = np.clip(column, k // 2, width - 1 - k // 2)
        taken = fine[np.ix_(wrapped(row, height, mode), wrapped(column, width, mode))]
        taken = taken.astype(np.float64)
        x, y = np.moveaxis(taken / np.sqrt(1 - (taken**2).sum(axis=2, keepdims=True)), 2, 0)
        result.append([np.average(m, weights=weight) for m in (x, y, x * x, y * y, x * y)])
    return np.array(result)


@dataclass(frozen=True)
class Truth:
    """A reference image and its error.

    ``image`` is H×W×C; ``standard_error``, of the same shape, is one standard deviation of its
    noise, measured from the spread of independent passes.
    """

    image: np.ndarray
    standard_error: np.ndarray

    @property
    def relative_error(self) -> float:
        """Standard deviation of the noise over the mean of the image, both over all pixels."""
        return float(np.sqrt((self.standard_error**2).mean()) / self.image.mean())

    def relative_rmse(self, image: np.ndarray) -> float:
        """Root mean square difference of another image over the mean, without this one's noise.

        It is 0 where more noise would be subtracted than there is.
        """
        squared = ((np.asarray(image, np.float64) - self.image) ** 2).mean()
        squared -= (self.standard_error**2).mean()
        return float(np.sqrt(max(squared, 0)) / self.image.mean())


def reference_render(
    scene: mi.Scene,
    spp: int = 4096,
    passes: int = 16,
    seed: int = 0,
    report: Callable[[float], None] = lambda fraction: None,
) -> Truth:
    """Render the first sensor of a scene in independent passes, and tell the error.

    The scene has :func:`mirrors` for its glint BSDFs, and the samplers and integrator that it
    wishes; ``spp`` samples per pixel are divided over the ``passes``, at least 2. ``report``
    is called with the fraction done after each.

    Fireflies of a heavy-tailed estimate show in ``standard_error``, if they are there at all: what
    no sample has found, no error tells.
    """
    check(
        passes >= 2 and spp % passes == 0,
        "reference_render",
        "spp",
        f"a multiple of the number of passes, {passes}, which is at least 2",
        spp,
    )
    total, squares = 0.0, 0.0
    for index in range(passes):
        pass_seed = mi.sample_tea_32(seed, index)[0]
        image = mi.render(scene, spp=spp // passes, seed=int(pass_seed))
        image = np.asarray(dr.detach(image), np.float64)
        total, squares = total + image, squares + image**2
        report((index + 1) / passes)
    mean = total / passes
    variance = np.maximum(squares / passes - mean**2, 0) * passes / (passes - 1)
    return Truth(mean, np.sqrt(variance / passes))
