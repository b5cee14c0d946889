"""Reference images by brute force: a scene with a normal map, rendered without any P-NDF.

Mitsuba's own ``normalmap`` around a ``roughconductor`` of tiny roughness turns every point of the
map into a mirror. Pixels average by sampling alone, so images need thousands of samples per pixel.
But they do not depend on any footprint, structure or estimator of this package.

By definition, there is one difference from a glint BSDF. A bumped mirror reflects all light that
arrives, while the facets of a microsurface without masking count by the area that they turn to the
viewer, as ``w·m / (m_z w_z)``. Both agree at normal incidence. In other directions their means
agree with masking, or to first order in the slopes if these average to zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.maps.normalmap import NormalMap, wrapped

#: Roughness of the mirrors: a tenth of the radius of the sun's half vectors.
ALPHA = 2e-4


def mirrors(
    normal_map: NormalMap,
    subdivisions: int = 3,
    alpha: float = ALPHA,
    to_uv: object = None,
    **conductor: object,
) -> dict:
    """A dictionary of Mitsuba's own BSDFs for a map, for ``mi.load_dict``.

    Between texel centres, the normals of a glint BSDF are linear over triangles, but those of a
    ``bitmap`` texture are bilinear. So the map is refined. It is then exact at texel centres, and
    at (``subdivisions`` − 1) points between any two of them.

    Args:
        normal_map: the map.
        subdivisions: points per texel along each axis, an odd number, so that texel centres are
            among them.
        alpha: roughness of ``roughconductor``.
        to_uv: transform of the UV coordinates, as for a glint BSDF.
        conductor: further parameters of ``roughconductor``, such as ``material``.

    Raises:
        ParameterError: ``subdivisions`` is not odd.
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
        # Both would change the reflection of the mirrors.
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


def slope_moments(
    normal_map: NormalMap, uv: np.ndarray, axes: np.ndarray, k: int = 9
) -> np.ndarray:
    """Means, mean squares and mean products of slopes (N, 5: x, y, x², y², xy) of the map's mesh.

    They are weighted by Gaussian footprints, with the centres ``uv`` (N, 2) and the ``axes``
    (N, 2, 2), whose columns are du and dv in texels. The sums have k² points per texel, with k odd,
    out to 4 standard deviations. At the edge of a scratch, where the slope grows from 0 within a
    texel, the mean square of k points is too small by a share of 1/(4k²).
    """
    fine, mode = refined(normal_map, k), normal_map.wrap_mode
    height, width = k * normal_map.height, k * normal_map.width
    result = []
    for place, axis in zip(uv, axes, strict=True):
        covariance = axis @ axis.T
        extent = np.ceil(4 * np.sqrt(np.diag(covariance))).astype(int)
        centre = np.asarray(place) * [normal_map.width, normal_map.height]  # texels, from the edge
        corner = np.floor(centre).astype(int) - extent
        column, row = (
            np.arange(k * c, k * (c + 2 * e + 1)) for c, e in zip(corner, extent, strict=True)
        )
        offset = np.stack(np.meshgrid(*((x + 0.5) / k for x in (column, row))), -1) - centre
        inverse = np.linalg.inv(covariance)
        weight = np.exp(-0.5 * np.einsum("...i,ij,...j", offset, inverse, offset))
        if mode == "clamp":
            # Beyond its border, from the centre of the last texel on, the map is constant.
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

    Attributes:
        image: the image, H×W×C.
        standard_error: standard deviation of its noise, of the same shape, from the differences of
            independent passes.
    """

    image: np.ndarray
    standard_error: np.ndarray

    def __repr__(self) -> str:
        size = " × ".join(map(str, self.image.shape))
        return f"Truth({size}, relative error {self.relative_error:.2%})"

    @property
    def noise(self) -> float:
        """Standard deviation of the noise, over all pixels."""
        return float(np.sqrt((self.standard_error**2).mean()))

    @property
    def relative_error(self) -> float:
        """The noise over the mean of the image."""
        return float(self.noise / self.image.mean())

    def relative_rmse(self, image: np.ndarray) -> float:
        """Root mean square difference of another image, over the mean of this one.

        The noise of this image is subtracted; the result is 0 if it exceeds the difference.
        """
        squared = ((np.asarray(image, np.float64) - self.image) ** 2).mean()
        squared -= self.noise**2
        return float(np.sqrt(max(squared, 0)) / self.image.mean())


def reference_render(
    scene: mi.Scene,
    spp: int = 4096,
    passes: int = 16,
    seed: int = 0,
    report: Callable[[float], None] = lambda fraction: None,
) -> Truth:
    """Render the first sensor of a scene in independent passes, with the error of the result.

    The standard error includes fireflies, but only those that some sample has found.

    Args:
        scene: a scene with :func:`mirrors` in place of glint BSDFs, and any sampler and integrator.
        spp: samples per pixel of all passes together.
        passes: number of passes, at least 2.
        seed: seed of the image.
        report: called after each pass, with the fraction that is done.

    Raises:
        ParameterError: ``spp`` is not a multiple of ``passes``.
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
