"""The P-NDF of metallic flakes: flat elements without a map (Yan et al. 2016, section 5.1)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import ParameterError, check, check_whole
from glintbsdf.core.opaque import stored
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.lattice import BLOCK, Lattice
from glintbsdf.maps.poisson_disk import balanced_areas, cells_for, poisson_disk
from glintbsdf.microfacet.mean_plane import slope_of
from glintbsdf.pndf.base import register
from glintbsdf.pndf.elements.elements import NORMAL_REACH, Mixture, check_sigma_r
from glintbsdf.pndf.filters.moments import MomentPyramid
from glintbsdf.pndf.gaussian_elements import SIGMA_H, Gaussian
from glintbsdf.pndf.index.ellipses import BlocksOfEllipses
from glintbsdf.pndf.index.lists import SHIFT, Builder, QuadLists

#: Finest level of the pyramid of slope moments: its Gaussian is as wide as the narrowest footprint
#: that is not summed flake by flake.
FIRST_LEVEL = 8

#: Footprints whose minor standard deviation is below this, in mean distances of flakes, are summed
#: flake by flake. Under wider footprints, flakes with balanced areas cover the surface evenly,
#: within 1e-3, so that their mass W is 1.
MIN_SIGMA_OF_LISTS = 2.6

#: Memory that building takes, and memory that the lists may take, in bytes per flake.
BYTES_TO_BUILD, BYTES_OF_LISTS = 600, 42


class BlocksOfFlakes(BlocksOfEllipses):
    """The cells that hold a flake, as blocks for the builder of the lists."""

    def __init__(self, lattice: Lattice, ellipses, occupied, count: int) -> None:
        super().__init__(lattice, ellipses, shapes_each=1)
        self.occupied = occupied
        self.mean_count = count / (self.rows * self.columns)

    def shapes(self, block_row, block_column, quad, active):
        exists, ellipses = super().shapes(block_row, block_column, quad, active)
        row = block_row * BLOCK + (quad >> SHIFT)
        column = block_column * BLOCK + (quad & (BLOCK - 1))
        return exists & self.occupied(row, column, exists), ellipses


@dataclass
class Surroundings:
    """A square around ``mean`` (cells) in place of a kernel; ``reach_v`` is half its side."""

    mean: mi.Point2f
    reach_v: mi.Float

    def row_extent(self, top, bottom):
        return -self.reach_v, self.reach_v


@register(
    "flakes",
    title="flakes",
    plugin="glint_elements",
    takes_map=False,
    options={"density": 4000.0},
    settings={"flake_density": 4000.0},
)
class Flakes(Mixture):
    """The P-NDF of flat elements scattered over the unit UV square, which repeats.

    Seeds are a Poisson-disk pattern. Each flake has one normal, drawn from a Beckmann distribution.
    The flakes cover the whole surface: a small footprint sees the flake that is nearest to it. The
    object belongs to the variant of Mitsuba that is active when it is made.

    Args:
        density (float): flakes per unit of UV area, rounded to a whole number ≥ 1.
        alpha (float): Beckmann roughness α of the flakes' normals, ≥ 0.
        sigma_r (float): intrinsic roughness σ_r of each flake, in [1e-8, 1].
        seed (int): seed of the pattern and of the normals, ≥ 0.
        owner (str): the name that errors give, usually the plugin's.

    Attributes:
        flake_alpha (mi.Float): α. Derivatives with respect to it leave every flake in its place,
            and scale its slope.
        flake_density (mi.Float): flakes per unit of UV area; other values scatter other flakes. Its
            derivatives are those of a pattern that shrinks, see :meth:`.Footprint.among_details`.

    Raises:
        ParameterError: a parameter is out of range, or there are more flakes than half of the
            machine's memory can build; this is checked before anything is allocated.
    """

    roughness_keys = ("flake_alpha", "sigma_r")

    wrap_mode = "repeat"
    origin = (-0.5, -0.5)  # the first cell begins at the corner of the square
    point_cut = 16.0  # 1.7 mean distances of flakes: no gap between flakes is as wide

    def __init__(
        self,
        density: float,
        alpha: float = 0.2,
        sigma_r: float = 0.005,
        seed: int = 0,
        owner: str = "Flakes",
    ) -> None:
        check_sigma_r(owner, sigma_r)
        check_density(owner, density)
        check_alpha(owner, alpha)
        check_whole(seed, lambda value: value >= 0, owner, "seed", "≥ 0")
        self.seed, self.owner = seed, owner
        self.flake_density = mi.Float(density)
        self.sigma_r, self.flake_alpha = mi.Float(sigma_r), mi.Float(alpha)
        self.strew(round(density))
        self.build()

    def strew(self, count: int) -> None:
        """Scatter so many flakes. Their number is a variable of kernels, as that of texels is."""
        check_memory(self.owner, count)
        self.count = count
        flakes = self.cached(self.scatter, count, self.seed)
        n = cells_for(count)
        self.map_cells, self.row_pitch = (n, n), dr.opaque(mi.UInt32, n)
        self.variance = dr.opaque(mi.Float, (SIGMA_H * n / sqrt(count)) ** 2)
        self.lattice = Lattice(n, n, "repeat")
        self.places, self.deviates = flakes["places"], flakes["deviates"]
        self.areas = stored(mi.Float, flakes["areas"].ravel())
        self.exist = flakes["areas"].ravel() > 0
        self.densest = dr.opaque(mi.Float, float(flakes["densest"]))
        self.turn(self.flake_alpha[0])
        self.element_bytes = 4 * (dr.width(self.flakes) + dr.width(self.areas))

    def scatter(self) -> dict[str, np.ndarray]:
        """Positions, areas and normal deviates of the flakes, by cell (n×n), and a bound on the sum
        of their Gaussians. A flake's slope is its two deviates times α/√2."""
        rng = np.random.default_rng(self.seed)
        places = poisson_disk(self.count, rng)
        areas = balanced_areas(places)
        return {
            "places": np.nan_to_num(places).astype(np.float32).reshape(-1, 2),
            "deviates": rng.standard_normal(places.shape).reshape(-1, 2),
            "areas": areas,
            "densest": np.array(densest(places, areas)),
        }

    def turn(self, alpha: float) -> None:
        """Give the flakes the normals of a roughness; derivatives flow from ``flake_alpha``."""
        slopes = (alpha / sqrt(2)) * self.deviates
        normals = slopes / np.sqrt(1 + np.square(slopes).sum(axis=-1, keepdims=True))
        self.flake_normals = normals[self.exist].astype(np.float32)
        normals = vectors(normals)
        if dr.grad_enabled(self.flake_alpha):
            deviates = vectors(self.deviates)
            slopes = self.flake_alpha * (1 / sqrt(2)) * deviates
            normals = slopes * dr.rsqrt(1 + dr.squared_norm(slopes))
        place = vectors(self.places)
        self.flakes = dr.ravel(mi.Vector4f(place.x, place.y, normals.x, normals.y))
        dr.eval(self.flakes)

    def alpha_squared(self) -> mi.Vector2f:
        return mi.Vector2f(dr.square(self.flake_alpha))

    def normal_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        # The margin keeps the normals at the border inside of the grid of lists.
        outer = (NORMAL_REACH + 1.5) * self.sigma_r[0]
        return self.flake_normals.min(0) - outer, self.flake_normals.max(0) + outer

    def build(self, domain: Domain | None = None) -> None:
        """Build everything that depends on ``sigma_r``, for any query."""
        # A variable, or every roughness would need kernels of its own.
        reach = dr.opaque(mi.Float, NORMAL_REACH * self.sigma_r[0])

        def ellipses(row, column, active):
            normal = dr.detach(self.flake(row, column, active)[1])
            return ((normal, mi.Vector2f(reach, 0), mi.Vector2f(0, reach)),)

        def occupied(row, column, active):
            return dr.gather(mi.Float, self.areas, self.index(row, column), active) > 0

        blocks = BlocksOfFlakes(self.lattice, ellipses, occupied, self.count)

        def build_lists(allowed: float = BYTES_OF_LISTS) -> dict[str, np.ndarray]:
            normals = stored(mi.Float, self.flake_normals.astype(np.float32).ravel())
            return Builder(blocks, normals, self.normal_bounds(), allowed).arrays()

        key = self.count, self.flake_alpha[0], self.seed, self.sigma_r[0]
        self.lists = QuadLists(self.lattice, self.cached(build_lists, *key))
        # With no memory for lists by normal, there is one list of all flakes, block by block.
        self.all = QuadLists(self.lattice, build_lists(0))
        self.slopes = self.make_slopes() if self.masked else None

    def index(self, row, column):
        return mi.UInt32(row) * self.row_pitch + mi.UInt32(column)

    def weigh(self, footprint):
        growth = self.flake_density / dr.detach(self.flake_density)
        return super().weigh(footprint.among_details(growth))

    def flake(self, row, column, active):
        """Position in its cell (cells), and projected normal, of the flake of a cell."""
        x, y, normal_x, normal_y = dr.gather(
            mi.Vector4f, self.flakes, self.index(row, column), active
        )
        return mi.Vector2f(x, y), mi.Vector2f(normal_x, normal_y)

    def lobes(self, kernel, query=None):
        roughness = Gaussian((), dr.square(self.sigma_r))

        def lobes(row, column, corner, active):
            place, normal = self.flake(row, column, active)
            area = dr.gather(mi.Float, self.areas, self.index(row, column), active)
            rho_squared = dr.squared_norm(kernel.whitened(corner + place))
            yield area, rho_squared, normal, None, roughness

        return lobes

    def make_slopes(self) -> MomentPyramid:
        """The flakes' slopes and their products, weighted by area and summed in each cell; a cell
        of mean area has weight 1."""
        n = self.map_cells[0]
        index = dr.arange(mi.UInt32, n * n)
        normal = self.flake(index // n, index % n, True)[1]
        slope, mean_area = slope_of(normal), dr.mean(self.areas)
        x, y = slope * (self.areas / mean_area)
        records = [x, y, x * slope.x, x * slope.y, y * slope.y]
        shape = dr.zeros(mi.TensorXf, (n, n, 2))
        return MomentPyramid(shape, "repeat", None, first=FIRST_LEVEL, records=records)

    def slope_moments(self, query, active):
        x, y, xx, xy, yy = self.slopes.average(query, active)
        return mi.Vector2f(x, y), (xx - x * x, xy - x * y, yy - y * y)

    def is_small(self, kernel, steps):
        return steps < MIN_SIGMA_OF_LISTS

    def sum_all(self, kernel, add, active, zero):
        return self.all.visit(mi.Vector2f(0), kernel, add, active, zero)

    def mass(self, kernel):
        return mi.Float(1)

    def draw_seed(self, position, random_x, random_y, active):
        def add(state, row, column, corner, active):
            total, left, x, y, offset = state
            place, _ = self.flake(row, column, active)
            area = dr.gather(mi.Float, self.areas, self.index(row, column), active)
            weight = area * dr.exp((-0.5 / self.variance) * dr.squared_norm(corner + place))
            weight = dr.select(active, weight, 0)
            total = total + weight
            share = weight / dr.maximum(total, 1e-30)
            # Reservoir sampling with one random number: it is rescaled after each decision.
            taken = left < share
            left = dr.select(taken, left / share, (left - share) / (1 - share))
            return (
                total,
                left,
                dr.select(taken, column, x),
                dr.select(taken, row, y),
                dr.select(taken, corner + place, offset),
            )

        surroundings = Surroundings(position, 5 * dr.sqrt(self.variance))
        state = mi.Float(0), mi.Float(random_x), mi.Int(0), mi.Int(0), mi.Vector2f(0)
        total, _, x, y, offset = self.all.visit(mi.Vector2f(0), surroundings, add, active, state)
        return x, y, position + offset, total / (2 * pi * self.variance * self.densest)

    def element(self, x, y, active):
        return self.flake(y, x, active)[1], None

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("sigma_r", self.sigma_r, mi.ParamFlags.Differentiable)
        callback.put("flake_alpha", self.flake_alpha, mi.ParamFlags.Differentiable)
        callback.put("flake_density", self.flake_density, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check new values, and rebuild."""
        if keys and not {"sigma_r", "flake_alpha", "flake_density"} & set(keys):
            return
        check_sigma_r(self.owner, self.sigma_r[0])
        check_alpha(self.owner, self.flake_alpha[0])
        check_density(self.owner, self.flake_density[0])
        self.changed = True
        count = round(self.flake_density[0])
        if count != self.count:
            self.strew(count)
        self.turn(self.flake_alpha[0])
        self.build()

    def parts(self) -> dict[str, int]:
        return {**super().parts(), "lists of flakes by place": self.all.nbytes}

    def __repr__(self) -> str:
        return (
            f"Flakes[{self.count} flakes, alpha={self.flake_alpha[0]:g}, "
            f"sigma_r={self.sigma_r[0]:g}, seed={self.seed}, {self.nbytes / 2**20:.1f} MiB]"
        )


def vectors(rows: np.ndarray) -> mi.Vector2f:
    """The rows of an array (N, 2)."""
    return mi.Vector2f(*(stored(mi.Float, column.astype(np.float32)) for column in rows.T))


def check_density(owner: str, density: float) -> None:
    """Raise :class:`~.ParameterError` for a density of flakes that is not allowed."""
    check(1 <= density < inf, owner, "flake_density", "a finite number ≥ 1", density)


def check_alpha(owner: str, alpha: float) -> None:
    """Raise :class:`~.ParameterError` unless the roughness of flakes is finite and ≥ 0."""
    check(0 <= alpha < inf, owner, "flake_alpha", "a finite number ≥ 0", alpha)


def densest(places: np.ndarray, areas: np.ndarray) -> float:
    """A bound on the sum of the flakes' Gaussians, anywhere, from its values on a grid.

    The grid has two points per cell. The sum is smooth at the scale of σ_h, which is 0.8 cells. No
    point of the surface is farther than 0.36 cells from the grid, so the sum exceeds its largest
    value on the grid by less than a tenth.
    """
    n = len(places)
    row, column = np.nonzero(areas)
    sigma = 2 * SIGMA_H * n / sqrt(len(row))  # in half cells
    steps = np.arange(-ceil(4 * sigma), ceil(4 * sigma) + 1)

    def spread(cells, offsets):
        """The grid points along an axis that a flake reaches, and its Gaussian there."""
        position = 2 * (cells + offsets)[:, None]
        points = np.floor(position).astype(np.int64) + steps
        weights = np.exp((-0.5 / sigma**2) * np.square(points + 0.5 - position))
        return points.T % (2 * n), weights.T.astype(np.float32)

    offsets, area = places[row, column], areas[row, column]
    columns, weights_x = spread(column, offsets[:, 0])
    rows, weights_y = spread(row, offsets[:, 1])
    total = np.zeros((2 * n, 2 * n), np.float32)
    for y, weight_y in zip(rows, weights_y, strict=True):
        for x, weight_x in zip(columns, weights_x, strict=True):
            # No two flakes are in the same half cell, so no point occurs twice in this sum.
            total[y, x] += area * weight_y * weight_x
    return 1.1 * float(total.max()) * 4 / (2 * pi * sigma**2)


def check_memory(owner: str, count: int) -> None:
    """Raise :class:`~.ParameterError` for more flakes than half of the memory can build."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    needed = count * BYTES_TO_BUILD
    if needed > available:
        raise ParameterError(
            f'{owner}: "flake_density" must be at most {available // BYTES_TO_BUILD} on this '
            f"machine: {count} flakes need {needed / 2**30:.3g} GiB to build, of "
            f"{available / 2**30:.3g} GiB (got {count})"
        )
