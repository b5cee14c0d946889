"""Seeded procedural normal maps.

Each function returns a :class:`~.NormalMap` that tiles without a seam
(``wrap_mode`` repeat) and depends on its arguments only. ``size`` is the number of texels along
both axes, or a pair (height, width), any numbers from 1 on. Lengths are in texels; angles are in
radians and turn from u towards v. Parameters out of range raise
:class:`~.ParameterError`.

``alpha`` is a Beckmann roughness: √2 times the standard deviation of the slope along an axis. Where
it describes the whole map it is reached exactly, not on average. An axis of one or two texels has
no slopes, because its texels have the same neighbour on both sides.
"""

from __future__ import annotations

import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.maps.normalmap import NormalMap

Size = int | tuple[int, int]


def flat(size: Size) -> NormalMap:
    """A mirror: every normal is (0, 0, 1)."""
    return NormalMap(np.zeros((*_shape("flat", size), 2), np.float32))


def tilted(size: Size, tilt: float = 0.2, azimuth: float = 0.0) -> NormalMap:
    """A tilted mirror: every normal leans by ``tilt``, in [0, π/2), towards ``azimuth``."""
    shape = _shape("tilted", size)
    check(0 <= tilt < np.pi / 2, "maps.tilted", "tilt", "in [0, π/2)", tilt)
    check(bool(np.isfinite(azimuth)), "maps.tilted", "azimuth", "a finite number", azimuth)
    normal = np.sin(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
    return NormalMap(np.broadcast_to(normal, (*shape, 2)))


def isotropic(
    size: Size, alpha: float = 0.15, correlation_length: float = 6.0, seed: int = 0
) -> NormalMap:
    """A rough surface: Gaussian heights, autocorrelation exp(-(r / correlation_length)²)."""
    shape = _shape("isotropic", size)
    _check_at_least("isotropic", 0, alpha=alpha, correlation_length=correlation_length)
    height = _gaussian_noise(
        shape, (correlation_length, correlation_length), 0.0, np.random.default_rng(seed)
    )
    return NormalMap.from_array(_with_roughness(height, alpha))


def brushed(
    size: Size,
    alpha: float = 0.2,
    streak_length: float = 200.0,
    streak_width: float = 4.0,
    angle: float = 0.0,
    seed: int = 0,
) -> NormalMap:
    """Brushed metal: Gaussian heights whose streaks run along the direction ``angle``.

    ``alpha`` is the roughness across the streaks; along them it is less by the ratio
    ``streak_width / streak_length``, as for any height with these two correlation lengths.
    """
    shape = _shape("brushed", size)
    _check_at_least(
        "brushed", 0, alpha=alpha, streak_length=streak_length, streak_width=streak_width
    )
    check(bool(np.isfinite(angle)), "maps.brushed", "angle", "a finite number", angle)
    height = _gaussian_noise(
        shape, (streak_length, streak_width), angle, np.random.default_rng(seed)
    )
    return NormalMap.from_array(_with_roughness(height, alpha, across=angle + np.pi / 2))


def scratched(
    size: Size,
    coverage: float = 0.15,
    length: float = 250.0,
    width: float = 6.0,
    slope: float = 0.3,
    alpha: float = 0.02,
    seed: int = 0,
) -> NormalMap:
    """Polished metal with scratches in all directions.

    ``coverage`` is the mean number of scratches over a texel: number x length x width over the area
    of the map. Each scratch is a shallow arc that fades towards its ends; its cross-section is a
    smooth groove ``width`` wide, whose sides reach between half and all of ``slope``. Where
    scratches cross, the deeper one is left. ``alpha`` is the roughness of the polish between them.
    """
    shape = _shape("scratched", size)
    _check_at_least("scratched", 0, coverage=coverage, slope=slope, alpha=alpha)
    _check_at_least("scratched", 1, length=length, width=width)
    rng = np.random.default_rng(seed)
    polish = _with_roughness(_gaussian_noise(shape, (4.0, 4.0), 0.0, rng), alpha)
    count = rng.poisson(coverage * shape[0] * shape[1] / (length * width))
    return NormalMap.from_array(polish + _grooves(shape, count, length, width, slope, rng))


def flakes(size: Size, alpha: float = 0.2, flake_size: float = 8.0, seed: int = 0) -> NormalMap:
    """Metallic flakes: flat facets, about ``flake_size`` texels wide, each with its own normal.

    Slopes are drawn from the Beckmann distribution of roughness ``alpha``; the map's own roughness
    therefore scatters about it, by about 1/√(number of flakes).
    """
    shape = _shape("flakes", size)
    _check_at_least("flakes", 0, alpha=alpha)
    _check_at_least("flakes", 1, flake_size=flake_size)
    rng = np.random.default_rng(seed)
    count, nearest, _, _ = _voronoi(shape, flake_size, rng)
    slopes = rng.normal(scale=alpha / np.sqrt(2), size=(count, 2))
    normals = slopes / np.sqrt(1 + np.sum(slopes**2, axis=1, keepdims=True))
    return NormalMap(normals.astype(np.float32)[nearest])


def leather(
    size: Size,
    alpha: float = 0.25,
    grain_size: float = 24.0,
    crease_width: float = 0.25,
    seed: int = 0,
) -> NormalMap:
    """Leather: rounded grains, about ``grain_size`` texels wide, parted by creases.

    ``crease_width`` is a fraction of the grain. ``alpha`` is the roughness of the whole map.
    """
    shape = _shape("leather", size)
    _check_at_least("leather", 0, alpha=alpha, crease_width=crease_width)
    _check_at_least("leather", 2, grain_size=grain_size)
    rng = np.random.default_rng(seed)
    _, _, first, second = _voronoi(shape, grain_size, rng)
    # Distance to the border between two grains, in grains; a crease is where it vanishes.
    border = (second - first) / grain_size
    grain = 1 - np.exp(-border / crease_width)
    pores = _gaussian_noise(shape, (grain_size / 8, grain_size / 8), 0.0, rng)
    return NormalMap.from_array(_with_roughness(grain + 0.03 * pores, alpha))


# -------------------------------------------------------------------------------------------------
# Building blocks
# -------------------------------------------------------------------------------------------------


def _gaussian_noise(
    shape: tuple[int, int],
    correlation_lengths: tuple[float, float],
    angle: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Periodic Gaussian noise of unit variance, an H x W float32 array.

    Its autocorrelation is exp(-(x'/l_0)² - (y'/l_1)²) in axes x', y' turned by ``angle``: white
    noise times the root of that function's Fourier transform.
    """
    y, x = np.meshgrid(
        np.fft.fftfreq(shape[0]).astype(np.float32),
        np.fft.rfftfreq(shape[1]).astype(np.float32),
        indexing="ij",
        sparse=True,
    )
    cosine, sine = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    exponent = (np.float32(correlation_lengths[0]) * (cosine * x + sine * y)) ** 2 + (
        np.float32(correlation_lengths[1]) * (cosine * y - sine * x)
    ) ** 2
    spectrum = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32))
    spectrum *= np.exp(np.float32(-(np.pi**2) / 2) * exponent)
    spectrum[0, 0] = 0
    noise = np.fft.irfft2(spectrum, s=shape)
    deviation = noise.std()
    return noise / deviation if deviation > 0 else noise  # constant on a map of one texel


def _with_roughness(height: np.ndarray, alpha: float, across: float | None = None) -> np.ndarray:
    """Scale a periodic height to a mean squared slope of alpha²/2 per axis, or along ``across``."""
    slope_x = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) / 2
    slope_y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / 2
    if across is None:
        axes = (shape > 2 for shape in height.shape)
        variance = (np.mean(slope_x**2) + np.mean(slope_y**2)) / max(1, sum(axes))
    else:
        variance = np.mean((np.cos(across) * slope_x + np.sin(across) * slope_y) ** 2)
    return height * np.float32(alpha / np.sqrt(2 * variance)) if variance > 0 else height


def _grooves(
    shape: tuple[int, int],
    count: int,
    length: float,
    width: float,
    slope: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Heights, zero or negative, of ``count`` random scratches; see :func:`scratched`.

    A scratch is followed along its major axis, x or y, whichever is nearer to its direction: at
    every texel of that axis it covers a few texels of the other, its minor axis.
    """
    half_length, half_width = length / 2, width / 2
    tangent = np.tan(rng.uniform(-np.pi / 4, np.pi / 4, (count, 1, 1)))
    curvature = rng.normal(scale=0.3, size=(count, 1, 1)) / length  # radians per texel
    major_is_y = rng.integers(2, size=(count, 1, 1), dtype=bool)
    # Any whole number of periods spreads the middles evenly over the periodic map.
    middle = rng.uniform(0, shape[0] * shape[1], (2, count, 1, 1))

    along = np.arange(-np.ceil(half_length), np.ceil(half_length) + 1)[:, None]
    reach = np.ceil(half_width * np.sqrt(2)) + 1  # it leans by 45 degrees at most
    beside = np.arange(-reach, reach + 1)
    arc = along * np.sqrt(1 + tangent**2)
    centre = middle[1] + along * tangent + arc**2 * curvature / 2
    minor = np.floor(centre) + beside
    distance = (minor + 0.5 - centre) / np.sqrt(1 + (tangent + arc * curvature) ** 2)
    # (1 - x²)² is steepest at x = 1/√3, where its slope is 8/(3√3).
    depth = rng.uniform(0.5, 1, (count, 1, 1)) * slope * half_width * 3 * np.sqrt(3) / 8
    groove = np.maximum(0, 1 - (distance / half_width) ** 2) ** 2 * np.maximum(
        0, 1 - (arc / half_length) ** 2
    )
    major = np.floor(middle[0]) + along
    row = np.where(major_is_y, major, minor).astype(int) % shape[0]
    column = np.where(major_is_y, minor, major).astype(int) % shape[1]
    height = np.zeros(shape, np.float32)
    np.minimum.at(height, (row, column), (-depth * groove).astype(np.float32))
    return height


def _voronoi(
    shape: tuple[int, int], cell_size: float, rng: np.random.Generator
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Periodic Voronoi cells of a jittered grid of points.

    Returns the number of points, and for each texel the index of the nearest point, its distance
    and the distance of the second nearest, in texels. Points are searched in the 3 x 3 grid cells
    around a texel, which hold the nearest one but for rare texels at a border.
    """
    grid = np.array([max(1, round(n / cell_size)) for n in shape])
    cell = (np.array(shape) / grid).astype(np.float32)
    jitter = rng.uniform(0, 1, (*grid, 2)).astype(np.float32)
    y = np.arange(shape[0], dtype=np.float32)[:, None] + np.float32(0.5)
    x = np.arange(shape[1], dtype=np.float32)[None, :] + np.float32(0.5)
    row, column = (y / cell[0]).astype(np.int32), (x / cell[1]).astype(np.int32)

    nearest = np.zeros(shape, np.int32)
    first, second = np.full((2, *shape), np.inf, np.float32)
    for row_offset in (-1, 0, 1):
        for column_offset in (-1, 0, 1):
            i, j = row + row_offset, column + column_offset
            point = jitter[i % grid[0], j % grid[1]]
            distance = np.hypot(
                (i + point[..., 0]) * cell[0] - y, (j + point[..., 1]) * cell[1] - x
            )
            closer = distance < first
            second = np.where(closer, first, np.minimum(second, distance))
            first = np.minimum(first, distance)
            nearest = np.where(closer, i % grid[0] * grid[1] + j % grid[1], nearest)
    return int(grid.prod()), nearest, first, second


# -------------------------------------------------------------------------------------------------
# Checks
# -------------------------------------------------------------------------------------------------


def _shape(name: str, size: Size) -> tuple[int, int]:
    pair = size if isinstance(size, tuple | list) else (size, size)
    valid = len(pair) == 2 and all(isinstance(n, int | np.integer) and n >= 1 for n in pair)
    check(valid, f"maps.{name}", "size", "a positive integer or a pair (height, width)", size)
    return int(pair[0]), int(pair[1])


def _check_at_least(name: str, minimum: float, **parameters: float) -> None:
    for parameter, value in parameters.items():
        check(
            bool(np.isfinite(value) and value >= minimum),
            f"maps.{name}",
            parameter,
            f"a finite number of at least {minimum}",
            value,
        )
