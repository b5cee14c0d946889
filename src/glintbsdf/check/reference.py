"""The reference: a P-NDF by brute force in float64. It shares no code with the estimators.

It follows the definition of the P-NDF: draw positions from the footprint's kernel, look up the
normal there, and count the normals in each bin of a grid over the unit disk. The only error is
noise, and the noise is known: samples are independent, so counts are binomial.

The surface is the mesh of Wu et al. 2024 (Wu24), whose vertices are the texel centres. The quad of
texels ``n0 = (i, j)``, ``n1 = (i, j+1)``, ``n2 = (i+1, j)``, ``n3 = (i+1, j+1)`` has the triangles
``(n0, n1, n2)`` and ``(n3, n2, n1)``, over which the projected normal is linear. A triangle that
maps almost to a point would make the density infinite. So an equilateral triangle replaces each
triangle whose ``|det J|``, twice its area on the disk, is below ``epsilon``. It is centred at
``(n1 + n2)/2`` and has the circumradius ``√(2 epsilon / (3√3))``, so that ``|det J| = epsilon``.
Its corners, in the order above, are at the angles 90°, 210° and 330° from the centre.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from glintbsdf.core.errors import check, check_choice
from glintbsdf.maps.normalmap import NormalMap, wrapped

KERNELS = ("gaussian", "disk", "box")

_CHUNK = 1 << 19  # samples at a time: enough to hide NumPy's overhead, and still in the cache

Array = npt.NDArray[np.float64]
Bounds = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class BinnedPNDF:
    """A binned P-NDF, which unpacks as ``density, standard_error = …``.

    ``density`` is a res x res array, per unit area of the disk: element [i, j] is the mean of D
    over the bin ``edges_y[i] <= y < edges_y[i + 1]``, ``edges_x[j] <= x < edges_x[j + 1]``.
    ``standard_error`` is one standard deviation of its noise, never zero. ``bounds`` is
    ``((x_min, y_min), (x_max, y_max))``.
    """

    density: Array
    standard_error: Array
    bounds: Bounds

    def __repr__(self) -> str:
        (x_min, y_min), (x_max, y_max) = self.bounds
        rows, columns = self.density.shape
        return (
            f"BinnedPNDF({rows} × {columns} bins, x {x_min:.3g} to {x_max:.3g}, "
            f"y {y_min:.3g} to {y_max:.3g}, noise {self.noise_floor:.2%})"
        )

    def __iter__(self) -> Iterator[Array]:
        return iter((self.density, self.standard_error))

    @property
    def edges(self) -> tuple[Array, Array]:
        """Bin edges ``(edges_x, edges_y)``, of res + 1 numbers each."""
        (x_min, y_min), (x_max, y_max) = self.bounds
        res_y, res_x = self.density.shape
        return np.linspace(x_min, x_max, res_x + 1), np.linspace(y_min, y_max, res_y + 1)

    @property
    def bin_area(self) -> float:
        """Area of one bin on the disk."""
        (x_min, y_min), (x_max, y_max) = self.bounds
        return (x_max - x_min) * (y_max - y_min) / self.density.size

    def relative_l1(self, density: npt.ArrayLike) -> float:
        """Relative L1 difference ``Σ|density - self.density| / Σ self.density`` of another grid of
        the same shape."""
        return float(np.abs(np.asarray(density) - self.density).sum() / self.density.sum())

    @property
    def noise_floor(self) -> float:
        """The expected :meth:`relative_l1` of an exact density, from the noise of this one.

        The mean of ``|x|`` is √(2/π) times the standard deviation, for a Gaussian. Bins without a
        sample are left out: their mass is less than that of one sample.
        """
        noise = self.standard_error[self.density > 0].sum() / self.density.sum()
        return float(np.sqrt(2 / np.pi) * noise)


def binned_pndf(
    normal_map: NormalMap,
    uv: npt.ArrayLike,
    covariance: npt.ArrayLike,
    *,
    kernel: str = "gaussian",
    epsilon: float = 1e-6,
    sigma_r: float = 0.0,
    res: int = 128,
    bounds: Bounds | None = None,
    samples: int = 10_000_000,
    seed: int = 0,
) -> BinnedPNDF:
    """Estimate the P-NDF of a map under a footprint on a grid of ``res`` x ``res`` bins.

    Args:
        normal_map: the map.
        uv: the footprint's centre.
        covariance: the footprint's covariance in UV², a symmetric positive semidefinite 2 x 2
            matrix; see :func:`texel_covariance` for a footprint given in texels.
        kernel: ``gaussian`` (cut at the Mahalanobis distance ρ = 3 and renormalised), ``disk``
            (uniform over ρ <= 1.5) or ``box`` (uniform over ``|Δu| <= 1.5 σ_u``,
            ``|Δv| <= 1.5 σ_v``, from the covariance's diagonal).
        epsilon: smallest ``|det J|`` of a triangle, >= 0.
        sigma_r: standard deviation of an additional isotropic Gaussian roughness on the disk, >= 0.
        res: number of bins along each axis.
        bounds: rectangle ``((x_min, y_min), (x_max, y_max))`` of the grid; by default
            :func:`normal_bounds`. Normals outside of it are not counted. So the sum of the grid
            times the area of a bin is the probability of the rectangle.
        samples: number of samples.
        seed: seed of the samples.

    Raises:
        ParameterError: an argument is not allowed.
    """
    owner = "binned_pndf"
    check_choice(owner, "kernel", kernel, KERNELS)
    check(epsilon >= 0, owner, "epsilon", "zero or more", epsilon)
    check(0 <= sigma_r < np.inf, owner, "sigma_r", "zero or more", sigma_r)
    check(res >= 1, owner, "res", "at least 1", res)
    check(samples >= 1, owner, "samples", "at least 1", samples)
    centre = np.asarray(uv, np.float64)
    check(
        centre.shape == (2,) and bool(np.isfinite(centre).all()),
        owner,
        "uv",
        "two finite numbers",
        uv,
    )
    if bounds is None:
        bounds = normal_bounds(normal_map, epsilon, sigma_r)
    corners = np.asarray(bounds, np.float64)
    check(
        corners.shape == (2, 2) and bool((corners[0] < corners[1]).all()),
        owner,
        "bounds",
        "((x_min, y_min), (x_max, y_max))",
        bounds,
    )
    lower, upper = corners

    size = np.array([normal_map.width, normal_map.height], np.float64)
    centre = centre * size - 0.5
    covariance = _checked_covariance(covariance, owner) * np.outer(size, size)

    rng = np.random.default_rng(seed)
    vertices = normal_map.normals.astype(np.float64).reshape(-1, 2)
    counts = np.zeros(res * res, np.int64)
    for start in range(0, samples, _CHUNK):
        count = min(_CHUNK, samples - start)
        position = centre + _draw_offsets(kernel, covariance, count, rng)
        normal = _normals_at(position, vertices, normal_map, epsilon)
        if sigma_r > 0:
            normal += rng.normal(scale=sigma_r, size=normal.shape)
        bins = np.floor((normal - lower) * (res / (upper - lower))).astype(np.int64)
        bins = bins[((bins >= 0) & (bins < res)).all(axis=1)]
        counts += np.bincount(bins[:, 1] * res + bins[:, 0], minlength=res * res)

    bin_area = float(np.prod((upper - lower) / res))
    density = counts / (samples * bin_area)
    # Binomial, with one more sample of each outcome: then the error is never zero.
    probability = (counts + 1) / (samples + 2)
    standard_error = np.sqrt(probability * (1 - probability) / samples) / bin_area
    return BinnedPNDF(
        density.reshape(res, res),
        standard_error.reshape(res, res),
        (tuple(lower.tolist()), tuple(upper.tolist())),
    )


def texel_covariance(
    normal_map: NormalMap, sigma: float | tuple[float, float], angle: float = 0.0
) -> Array:
    """The UV² covariance of a footprint given in texels.

    ``sigma`` is the standard deviation along both axes, or a pair for two axes. The first of them
    has the ``angle`` (radians) from u towards v.
    """
    cosine, sine = np.cos(angle), np.sin(angle)
    size = np.array([normal_map.width, normal_map.height])
    axes = np.array([[cosine, -sine], [sine, cosine]]) * np.broadcast_to(sigma, 2) / size[:, None]
    return axes @ axes.T


def normal_bounds(normal_map: NormalMap, epsilon: float = 1e-6, sigma_r: float = 0.0) -> Bounds:
    """The rectangle that contains every normal of the map's surface.

    It has a margin on each side: the circumradius of a clamped triangle, 4 ``sigma_r``, and 1 %, so
    that no normal lies on its border.
    """
    normals = normal_map.normals.reshape(-1, 2).astype(np.float64)
    margin = _clamped_circumradius(epsilon) + 4 * sigma_r
    lower, upper = normals.min(axis=0) - margin, normals.max(axis=0) + margin
    lower, upper = lower - 0.01 * (upper - lower) - 1e-6, upper + 0.01 * (upper - lower) + 1e-6
    return (float(lower[0]), float(lower[1])), (float(upper[0]), float(upper[1]))


# -------------------------------------------------------------------------------------------------
# The steps of the estimate
# -------------------------------------------------------------------------------------------------


def _checked_covariance(covariance: npt.ArrayLike, owner: str) -> Array:
    matrix = np.asarray(covariance, np.float64)
    valid = matrix.shape == (2, 2) and bool(np.isfinite(matrix).all())
    if valid:
        tolerance = 1e-9 * np.abs(matrix).max()
        valid = abs(matrix[0, 1] - matrix[1, 0]) <= tolerance and bool(
            (np.linalg.eigvalsh(matrix) >= -tolerance).all()
        )
    check(valid, owner, "covariance", "a symmetric positive semidefinite 2 x 2 matrix", covariance)
    return matrix


def _draw_offsets(kernel: str, covariance: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw offsets from a kernel's centre: a count x 2 array, in units of the covariance's root."""
    if kernel == "box":
        return rng.uniform(-1.5, 1.5, (count, 2)) * np.sqrt(np.diag(covariance))
    u, angle = rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    if kernel == "disk":
        radius = 1.5 * np.sqrt(u)
    else:  # the Rayleigh distribution, cut at ρ = 3, where the Gaussian's mass is 1 - exp(-9/2)
        radius = np.sqrt(-2 * np.log1p(u * np.expm1(-4.5)))
    # Any root of the covariance will do; this one exists for singular matrices as well.
    variances, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variances, 0))
    return np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1) @ root.T


def _normals_at(position: Array, vertices: Array, normal_map: NormalMap, epsilon: float) -> Array:
    """Interpolate normals, N x 2, at positions in texels (texel centres at whole numbers)."""
    corner = np.floor(position)
    s, t = (position - corner).T
    column, row = corner.astype(np.int64).T
    in_first = s + t <= 1

    def vertex(row_offset: int | Array, column_offset: int | Array) -> Array:
        rows = wrapped(row + row_offset, normal_map.height, normal_map.wrap_mode)
        columns = wrapped(column + column_offset, normal_map.width, normal_map.wrap_mode)
        return vertices[rows * normal_map.width + columns]

    # The corners in the order of their triangle: (n0, n1, n2) or (n3, n2, n1).
    n1, n2 = vertex(0, 1), vertex(1, 0)
    lone = np.where(in_first, 0, 1)
    first = vertex(lone, lone)
    second = np.where(in_first[:, None], n1, n2)
    third = np.where(in_first[:, None], n2, n1)

    edge_1, edge_2 = second - first, third - first
    clamped = np.abs(edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]) < epsilon
    centre = (n1[clamped] + n2[clamped]) / 2
    angle = np.deg2rad([90, 210, 330])
    corners = _clamped_circumradius(epsilon) * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    first[clamped], second[clamped], third[clamped] = (centre + corner for corner in corners)

    weight_2 = np.where(in_first, s, 1 - s)[:, None]
    weight_3 = np.where(in_first, t, 1 - t)[:, None]
    return (1 - weight_2 - weight_3) * first + weight_2 * second + weight_3 * third


def _clamped_circumradius(epsilon: float) -> float:
    """Circumradius of an equilateral triangle of twice the area ``epsilon``."""
    return float(np.sqrt(2 * epsilon / (3 * np.sqrt(3))))
