"""The P-NDF of position-normal Gaussian elements.

Yan, Hašan, Marschner and Ramamoorthi, "Position-Normal Distributions for Efficient Rendering of
Specular Microstructure" (2016), section 5. Seeds on a lattice of step h carry Gaussians in
position × normal space. An element is flat (Eq. 12), or it follows the map's Jacobian (Eq. 13 and
14). The P-NDF is their mixture, seen through the footprint (Eq. 11). The integral of one element
(Eq. 15 to 21) is in :mod:`~glintbsdf.pndf.gaussian_elements`.

Beyond the paper: the mixture is divided by its mass under the footprint, which has a closed form,
so that it integrates to one. The sampler draws from this density, within the 1e-3 that evaluation
cuts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from math import ceil, exp, inf, log2, pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque, stored
from glintbsdf.core.tuning import tuning
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import BLOCK, Lattice, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap, map_bytes
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.microfacet.mean_plane import (
    area_of_moments,
    choose_areas,
    lobe_area,
    slope_along,
    slope_of,
    variance_along,
)
from glintbsdf.pndf.base import PNDF, changed_map, register
from glintbsdf.pndf.elements.levels import Levels
from glintbsdf.pndf.filters.filters import COVARIANCE
from glintbsdf.pndf.filters.moments import COARSE, MomentPyramid
from glintbsdf.pndf.gaussian_elements import (
    SIGMA_H,
    Gaussian,
    Overlap,
    averaged,
    lattice_mass,
    point_of_ellipse,
)
from glintbsdf.pndf.index.ellipses import BlocksOfEllipses
from glintbsdf.pndf.index.lists import Builder, QuadLists, every_quad
from glintbsdf.pndf.manifold.mesh import frame_in_quad
from glintbsdf.pndf.manifold.projected_area import mean_over_points
from glintbsdf.pndf.sharing import shared
from glintbsdf.pndf.smooth import SmoothBeckmann, smooth_alpha

#: Mahalanobis distance at which an element's normals are cut: 4.3e-4 of its mass lie outside. Only
#: large footprints cut them: the lists hold the elements within this distance.
NORMAL_REACH = 3.94

#: The same for queries with a light's spread, which reach farther. These lists are built when
#: lights are first integrated, as those of ``NORMAL_REACH`` take a fifth less time.
LIGHT_REACH = 4.6

#: Bounds of the roughness. Half vectors in float32 are 6e-8 apart, so that a roughness below 1e-7
#: shows only their rounding. From 1e-9 on, determinants underflow.
MIN_SIGMA_R, MAX_SIGMA_R = 1e-8, 1.0

#: Largest number of seeds per cell along an axis: the loop over the seeds of a cell is unrolled.
MAX_SEEDS = 4

#: The lists of elements serve while the variance that the light's spread and the half vector's turn
#: add is at most this multiple of the variance that the lists allow the median element. The lists
#: then miss less than 1 % of the mass.
LISTS_SPREAD = 3.0

#: The lists for lights allow flat elements this share of the variance by which the mean element
#: exceeds the median one. On maps that are flat between edges, merged elements blur by the mean
#: variance, so the lists serve up to lights about as wide as this.
FLAT_SHARE = 0.5

#: Memory allowed to the lists, in bytes per cell: with one seed per cell, and with several. The
#: whole structure then takes less memory than the paper reports.
BYTES_PER_CELL = 42, 64

#: Largest number of attempts of the rejection sampler. On a lattice nine in ten succeed, in a gap
#: between flakes a few in a hundred.
MAX_ATTEMPTS = 128


#: The weight of an element falls linearly to 0 over this width of ρ², up to the cut. ρ² is the
#: squared Mahalanobis distance from the footprint's centre in N(0, T).
FADE = 2.0


def cut_of_sums(sigma: mi.Float, point_cut: float) -> mi.Float:
    """ρ² of the cut where a sum over all elements gives D and its mass W.

    Any cut keeps ∫D = 1 here. A large footprint is cut like other kernels: half of the fade lies
    within 3 standard deviations, and half beyond. A point is cut at ``point_cut``.

    Args:
        sigma: minor standard deviation of T, in steps of the lattice.
        point_cut: ρ² of the cut for a footprint that is a point.
    """
    return 10 + (point_cut - 10) * SIGMA_H**2 / dr.square(sigma)


def cut_of_lists(sigma: mi.Float) -> mi.Float:
    """ρ² of the cut where the mass W has a closed form: W then ripples by less than 5e-4.

    ``sigma``: minor standard deviation of T, in steps of the lattice.
    """
    return 10 + 3.5 * dr.maximum(dr.log2(2.5 / sigma), 0)


def mass_under_fade(cut: mi.Float) -> mi.Float:
    """The mass of a Gaussian that fades to 0 at ρ² = ``cut``, relative to the whole Gaussian."""
    return 1 - dr.exp(-0.5 * cut) * ((exp(0.5 * FADE) - 1) * (2 / FADE))


class SeedAxis:
    """Seeds along one axis of a map of ``texels`` texels, about ``step`` texels apart.

    Seeds are grouped in cells. Where a whole number of steps makes a texel, a cell is the span
    between two texel centres, and all its seeds interpolate between these two. Otherwise a cell is
    one step and has one seed. The step is rounded so that a whole number of cells makes the map.

    Attributes:
        seeds (int): seeds per cell.
        cells (int): cells per map.
        cell (float): side of a cell, texels. Cell k begins k sides after the first texel's centre.
        offset (float): position of the first seed in a cell, in cells.
    """

    def __init__(self, texels: int, step: float) -> None:
        per_texel = round(1 / step)
        aligned = 1 <= per_texel <= MAX_SEEDS and abs(per_texel * step - 1) < 1e-6
        self.texels = texels
        self.seeds = per_texel if aligned else 1
        self.cells = texels if aligned else max(1, round(texels / step))
        self.cell = texels / self.cells
        # With at most one seed per texel, seeds stand midway between texel centres, where the
        # interpolation has no kink.
        self.offset = 0.5 / self.seeds if self.cell <= 1 else 0.5 / self.cell

    @property
    def places(self) -> list[float]:
        """Positions of the seeds in a cell, in cells."""
        return [self.offset + k / self.seeds for k in range(self.seeds)]

    @property
    def inner_cells(self) -> int:
        """Number of cells of a clamped map: all that begin before its last texel's centre, and one
        more."""
        return ceil((self.texels - 1) / self.cell) + 1

    def cell_of(self, seed: mi.Int) -> tuple[mi.Int, mi.Float]:
        """The cell of a seed, and the seed's position in the cell (cells)."""
        cell = floor_int((mi.Float(seed) + 0.5) * (1 / self.seeds))
        return cell, dr.fma(1 / self.seeds, mi.Float(seed - cell * self.seeds), self.offset)

    def texel(self, cell: mi.UInt32, place: mi.Float, wrap_mode: str) -> tuple[mi.Int, mi.Float]:
        """The stored quad of texels that holds the position ``place`` of a stored cell, and the
        position in the quad (texels)."""
        clamped = wrap_mode == "clamp"
        position = (mi.Float(cell) - (BLOCK if clamped else 0) + place) * self.cell
        if clamped:  # the map is constant beyond its border
            position = dr.clip(position, -1, self.texels - 0.5)
        texel = dr.floor(position)
        return mi.Int(texel) + (BLOCK if clamped else 0), position - texel


class Mixture(PNDF):
    """A P-NDF of Gaussian elements on a lattice of cells: the base class of all kinds of elements.

    A subclass sets

    Attributes:
        lattice (Lattice): the cells; a map has ``map_cells`` (columns, rows) of them.
        lists (QuadLists): for each bin of normals, the cells whose elements may contribute to it;
            None where all footprints are small.
        variance (float or mi.Float): variance σ_h² of an element's position (S = σ_h² I), cells².
        sigma_r (mi.Float): standard deviation σ_r of the normals of a flat element.
        wrap_mode (str): how the map continues beyond its border.

    and implements the methods that raise ``NotImplementedError`` here.
    """

    lattice: Lattice
    map_cells: tuple[int, int]
    lists: QuadLists | None
    variance: float | mi.Float
    sigma_r: mi.Float
    element_bytes: int
    wrap_mode: str

    maskings = ("footprint", "beckmann", "none")

    #: Moments of the map's slopes, and whether the masking needs them.
    slopes: MomentPyramid | None = None
    masked = False

    #: ρ² of the cut where the footprint is a point. Elements are interpolated there, and the
    #: nearest ones are the most accurate. No point of a lattice is farther than ρ² = 2.8 from the
    #: nearest element.
    point_cut = 4.0

    #: Merged elements, for queries with a light's spread; None until :meth:`prepare_for_lights`.
    levels: Levels | None = None

    #: Roughness that the lists are built for where ``sigma_r`` is smaller.
    listed = 0.0

    #: Corner of the first cell, in cells; (−½, −½) is the corner of the map.
    origin: tuple[float, ...] = (0.0, 0.0)

    def lobes(self, kernel: TexelKernel, query: Query | None = None) -> Callable:
        """The elements as the footprint sees them: a function ``(row, column, corner, active)``.

        The function yields the elements of a stored cell. ``corner`` is the cell's corner relative
        to the footprint's centre (cells). Of each element it yields ``(area, ρ², normal, shift,
        Gaussian)``: the element's area (cells), ρ² of its position, a projected normal, the offset
        of the mean normal from it (None for zero), and the distribution of normals about the mean.

        ``query`` gives the light's spread and the half vector's turn; without a query both are 0.
        """
        raise NotImplementedError

    def is_small(self, kernel: TexelKernel, steps: mi.Float) -> mi.Bool:
        """Whether D and W are sums over all elements under the footprint.

        ``steps``: minor standard deviation of T, in steps from one element to the next.
        """
        raise NotImplementedError

    def sum_all(self, kernel: TexelKernel, add: Callable, active, zero):
        """Sum over all cells with elements under the footprint; see :func:`every_quad`."""
        raise NotImplementedError

    def mass(self, kernel: TexelKernel) -> mi.Float:
        """W: the mass of all elements under a large footprint, without a cut."""
        raise NotImplementedError

    def turn_per_cell(self, query: Query) -> mi.Matrix2f | None:
        """The half vector's turn H, per cell; None where the query has none."""
        if query.turn is None:
            return None
        columns, rows = self.map_cells
        return query.turn @ mi.Matrix2f([[1 / columns, 0], [0, 1 / rows]])

    def draw_seed(self, position, random_x, random_y, active) -> tuple:
        """Draw an element in proportion to its Gaussian at ``position`` (cells).

        Returns the indices x and y of its seed, the seed's position (cells), and the probability
        with which the caller must accept it.
        """
        raise NotImplementedError

    def element(self, x, y, active) -> tuple:
        """Projected normal, and Jacobian per cell (None for a flat element), of a seed."""
        raise NotImplementedError

    def weights(self, query: Query) -> tuple[TexelKernel, mi.Bool, mi.Float]:
        """``(kernel, small, cut)``: the Gaussian N(0, T) that weights the elements, in cells;
        whether to sum over all that it covers; ρ² of its cut."""
        return query.once((self, "weights"), lambda: self.weigh(query.footprint))

    def weigh(self, footprint: Footprint) -> tuple[TexelKernel, mi.Bool, mi.Float]:
        """Compute what :meth:`weights` returns."""
        columns, rows = self.map_cells
        added = (self.variance, self.variance)
        kernel = TexelKernel("gaussian", footprint, rows, columns, self.wrap_mode, added)
        kernel.mean = kernel.mean - mi.Vector2f(*self.origin)
        steps = dr.sqrt(kernel.minor_variance) * (SIGMA_H * dr.rsqrt(self.variance))
        cut = cut_of_sums(steps, self.point_cut)
        kernel.cut_at(dr.sqrt(cut))
        small = self.is_small(kernel, steps)
        cut = dr.select(small, cut, cut_of_lists(steps))
        kernel.cut_at(dr.sqrt(cut))
        return kernel, small, cut

    def projected_areas(self, directions, query, active):
        """The projected areas of the elements; for large footprints, from the moments of slopes."""
        kernel, small, cut = self.weights(query)
        lobes = self.lobes(kernel)

        def add(sums, *cell):
            mass, slope, *areas = sums
            for area, rho_squared, normal, shift, normals in lobes(*cell):
                weight = area * dr.clip((cut - rho_squared) * (1 / FADE), 0, 1)
                weight = dr.select(cell[-1], weight * dr.exp(-0.5 * rho_squared), 0)
                mean = mi.Vector2f(normal if shift is None else normal + shift)
                mass, slope = mass + weight, slope + weight * slope_of(mean)
                areas = [
                    dr.fma(weight, lobe_area(w, mean, normals.vectors, normals.variance), total)
                    for w, total in zip(directions, areas, strict=True)
                ]
            return mass, slope, *areas

        zero = (mi.Float(0), mi.Vector2f(0), *(mi.Float(0) for _ in directions))
        mass, slope, *areas = self.sum_all(kernel, add, active & small, zero)
        inverse = dr.rcp(dr.select(mass > 0, mass, 1))
        summed = [area * inverse for area in areas], slope * inverse
        if self.slopes is None:
            return summed
        return choose_areas(small, summed, self.areas_of_many(directions, query, active & ~small))

    def areas_of_many(self, directions: list, query: Query, active: mi.Bool) -> tuple:
        """``(areas, mean slope)`` of a large footprint, from averages of the slopes' moments."""
        slope, covariance = self.slope_moments(query, active)
        # σ_r is a deviation of projected normals: as one of slopes, it grows with the mean slope.
        stretch = 1 + dr.squared_norm(slope)
        rough = dr.square(self.sigma_r) * stretch
        xx, xy, yy = covariance
        covariance = (
            dr.fma(rough, 1 + slope.x * slope.x, xx),
            dr.fma(rough, slope.x * slope.y, xy),
            dr.fma(rough, 1 + slope.y * slope.y, yy),
        )
        areas = [
            area_of_moments(slope_along(w, slope), variance_along(w, covariance))
            for w in directions
        ]
        return areas, slope

    def slope_moments(self, query: Query, active: mi.Bool) -> tuple[mi.Vector2f, tuple]:
        """Mean of the map's slopes under a large footprint, and their covariance (xx, xy, yy)."""
        raise NotImplementedError

    def make_slopes(self) -> MomentPyramid | None:
        """The pyramid that :meth:`slope_moments` averages; None where no footprint is large."""
        raise NotImplementedError

    def masking(self, name: str, height_correlated: bool = True) -> SmithMasking | None:
        self.masked = name == "footprint"
        if self.masked:
            self.slopes = self.make_slopes()
        return super().masking(name, height_correlated)

    def overlap(self, kernel: TexelKernel) -> Overlap:
        """The overlap of the footprint with an element, which is the same for all elements."""
        return Overlap(Gaussian((kernel.du, kernel.dv)), Gaussian(variance=self.variance))

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 11); 0 outside of it."""
        kernel, small, cut = self.weights(query)
        lobes = self.lobes(kernel, query)
        active = active & (dr.squared_norm(m) < 1)

        def seen(*cell):
            # Of each element its area, ρ², and the density of its normals at m times exp(−ρ²/2)
            for area, rho_squared, normal, shift, normals in lobes(*cell):
                delta = m - normal if shift is None else m - normal - shift
                yield area, rho_squared, averaged(normals, query.spread).eval(delta, rho_squared)

        def share(area, rho_squared):
            return area * dr.clip((cut - rho_squared) * (1 / FADE), 0, 1)

        def add(density, *cell):
            total = mi.Float(0)
            for area, rho_squared, value in seen(*cell):
                total = dr.fma(share(area, rho_squared), value, total)
            return density + dr.select(cell[-1], total, 0)

        def add_both(sums, *cell):
            total = mi.Vector2f(0)
            for area, rho_squared, value in seen(*cell):
                weight = share(area, rho_squared)
                total = total + weight * mi.Vector2f(value, dr.exp(-0.5 * rho_squared))
            return sums + dr.select(cell[-1], total, 0)

        density, mass = self.sum_all(kernel, add_both, active & small, mi.Vector2f(0))
        merged = self.uses_merged(query, small)
        if self.lists is not None:
            listed = active & ~small & ~merged & self.lists.covers(m)
            density = density + self.lists.visit(m, kernel, add, listed)
        gaussian = 2 * pi * kernel.sigma_u_given_v * kernel.sigma_v
        gaussian = gaussian * mass_under_fade(cut)
        mass = dr.select(small, dr.select(mass > 0, mass, 1), gaussian * self.mass(kernel))
        density = density / mass
        if self.levels is not None and (query.spread or query.turn is not None):
            of_merged = self.levels.eval(m, query, dr.square(self.sigma_r), active & merged)
            density = dr.select(merged, of_merged, density)
        return dr.maximum(density, 0) if query.spread else density

    def listed_roughness(self) -> mi.Float:
        """The roughness that the lists are built for."""
        if not self.listed:
            return self.sigma_r
        return dr.maximum(self.sigma_r, opaque(mi.Float, self.listed))

    def uses_merged(self, query: Query, small: mi.Bool) -> mi.Bool:
        """Whether merged elements answer the query: the light's spread and the half vector's turn
        reach beyond the lists of elements. Never where the footprint is ``small``, as all elements
        are summed there."""
        if self.levels is None:
            return mi.Bool(False)
        variance = mi.Float(0)
        for v in query.spread:
            variance = variance + dr.squared_norm(v)
        if query.turn is not None:
            footprint = query.footprint
            for axis in (footprint.du, footprint.dv):
                variance = variance + dr.squared_norm(query.turn @ axis)
        # ``variance`` is of both components together, ``own`` is of one.
        own = dr.square(self.listed_roughness()) + opaque(
            mi.Float, self.curved_variance(self.levels.median_slope)
        )
        return ~small & (variance > 2 * LISTS_SPREAD * own)

    def curved_variance(self, slope: float) -> float:
        """Variance of each component of the normals of an element, by the slope of
        :class:`~.Levels`, which is that of both components together."""
        return 0.5 * slope**2 * self.variance / SIGMA_H**2

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D.

        First an element is drawn in proportion to its mass N(d; 0, T) under the footprint: a point
        u of the footprint, then an element in proportion to its Gaussian at u. The sum of these
        Gaussians differs from point to point; the element is accepted in proportion to this sum,
        which corrects for it. Then a normal of this element is drawn. The first point is made of
        the samples; all other random numbers are a hash of them.
        """
        kernel, _, cut = self.weights(query)
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(v)) for v in (sample1, *sample2)]

        def attempt(count, x, y, offset, active):
            first, second = (
                [uniform(b) for b in pcg3d(bits[0], bits[1], bits[2] + 3 * count + k)]
                for k in (0, 1)
            )
            point = dr.select(count == 0, mi.Point2f(sample2), mi.Point2f(first[0], first[1]))
            point = mi.warp.square_to_std_normal(point)
            position = kernel.mean + kernel.du * point.x + kernel.dv * point.y
            x, y, place, probability = self.draw_seed(position, second[0], second[1], active)
            offset = mi.Vector2f(place - kernel.mean)
            fade = (cut - dr.squared_norm(kernel.whitened(offset))) * (1 / FADE)
            accepted = second[2] < probability * dr.minimum(fade, 1)
            count = count + 1
            return count, x, y, offset, active & ~accepted & (count < MAX_ATTEMPTS)

        with dr.suspend_grad():
            count, x, y, offset, _ = symbolic_loop(
                (mi.UInt32(0), mi.Int(0), mi.Int(0), mi.Vector2f(0), mi.Bool(active)),
                lambda *state: state[-1],
                attempt,
                "element",
            )
        normal, jacobian = self.element(x, y, active)
        mean, distribution = normal, Gaussian((), dr.square(self.sigma_r))
        turn = self.turn_per_cell(query)
        if jacobian is not None or turn is not None:
            overlap = self.overlap(kernel)
            moved = relative_jacobian(jacobian, turn)
            mean = normal - moved @ overlap.mean(offset)
            if turn is not None:
                mean = mean - turn @ offset
            distribution = overlap.normals(moved, distribution)
        random = pcg3d(bits[0], bits[1], bits[2] + 3 * count + 2)
        z = mi.warp.square_to_std_normal(mi.Point2f(uniform(random[0]), uniform(random[1])))
        m = mean + distribution.sample(mi.Vector2f(z))
        if query.spread:
            random = pcg3d(bits[0], bits[1], bits[2] + 3 * count + 3)
            point = mi.Point2f(uniform(random[0]), uniform(random[1]))
            m = m + point_of_ellipse(query.spread, point)
        return m

    def smooth(self) -> SmoothBeckmann:
        return SmoothBeckmann(
            lambda: smooth_alpha(self.alpha_squared(), self.sigma_r),
            self.roughness_keys,
            self.owner,
        )

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        lists = 0 if self.lists is None else self.lists.nbytes
        parts = {"elements": self.element_bytes, "lists of elements": lists}
        if self.levels is not None:
            parts["merged elements"] = self.levels.nbytes
        if self.slopes is not None:
            parts[f"masking, MIP levels {self.slopes.first} to {self.slopes.top}"] = (
                self.slopes.nbytes
            )
        return parts


def draw_neighbour(x, random):
    """Draw an integer k in proportion to N(x − k; 0, σ_h²).

    Returns k, and the sum of these densities over all k.
    """
    first = dr.floor(x) - 2
    # Six integers are enough: all others together weigh less than 1e-10.
    weights = [dr.exp((-0.5 / SIGMA_H**2) * dr.square(x - first - k)) for k in range(6)]
    total = sum(weights)
    left, k = random * total, mi.Float(0)
    for weight in weights[:-1]:
        left = left - weight
        k = k + dr.select(left >= 0, 1, 0)
    return mi.Int(first + k), total * (1 / (SIGMA_H * sqrt(2 * pi)))


#: The largest sum that :func:`draw_neighbour` returns: it occurs at integers.
LARGEST_SUM = sum(exp(-0.5 * (k / SIGMA_H) ** 2) for k in range(-3, 4)) / (SIGMA_H * sqrt(2 * pi))


@register("elements", title="elements", plugin="glint_elements")
class Elements(Mixture):
    """The P-NDF of the elements of a normal map.

    Nothing is stored per element: its normal and Jacobian come from the four texels around it. The
    object belongs to the variant of Mitsuba that is active when it is made.

    Args:
        normal_map (NormalMap): the map; between texel centres, normals are those of the triangle
            mesh of :mod:`~glintbsdf.reference`.
        sigma_r (float): intrinsic roughness σ_r, the standard deviation of a projected normal, in
            [1e-8, 1].
        step (float): h, texels from one seed to the next, > 0. It is rounded so that a whole number
            of steps makes the map.
        curved (bool): whether elements follow the map's Jacobian (Eq. 13) or are flat (Eq. 12).
        owner (str): the name that errors give, usually the plugin's.
        domain (Domain): the queries to expect; None for any. Where all footprints are small, no
            lists are built. Within the domain D is the same to the last bit.
        data (mi.TensorXf): the normals of ``normal_map``, as an array that carries derivatives.
        listed (float): the lists are built for this roughness where ``sigma_r`` is smaller. So they
            serve for wider spreads of lights.

    Attributes:
        data (mi.TensorXf): the projected normals, H×W×2. Derivatives flow through it and through
            ``sigma_r``; after a change of values, :meth:`parameters_changed` rebuilds what depends
            on them.

    Raises:
        ParameterError: ``sigma_r`` or ``step`` is out of range.
    """

    normal_map: NormalMap
    integrates_lights = finds_environment = True
    bytes_per_texel = 110.0

    #: Mahalanobis distance at which the lists cut an element's normals.
    normal_reach = NORMAL_REACH

    def __init__(
        self,
        normal_map: NormalMap,
        sigma_r: float = 0.005,
        step: float = 0.5,
        curved: bool = True,
        owner: str = "Elements",
        domain: Domain | None = None,
        data: mi.TensorXf | None = None,
        listed: float = 0.0,
    ) -> None:
        check_sigma_r(owner, sigma_r)
        self.listed = self.least_listed = listed
        check(0 < step < inf, owner, "step", "a finite number > 0", step)
        self.check_room(normal_map, owner, domain)
        self.normal_map, self.step, self.curved, self.owner = normal_map, step, curved, owner
        self.wrap_mode = normal_map.wrap_mode
        self.data = stored(mi.TensorXf, normal_map.normals) if data is None else data
        self.changed = data is not None
        self.sigma_r = mi.Float(sigma_r)
        if self.changed:  # otherwise another map would need another kernel
            dr.make_opaque(self.sigma_r)
        self.build(domain)

    def build(self, domain: Domain | None = None) -> None:
        """Build everything that depends on ``data`` and ``sigma_r``, for queries in ``domain``."""
        self.domain = domain
        height, width, _ = self.data.shape
        self.place_seeds(height, width)
        x, y = self.axes
        self.texels = Lattice(height, width, self.wrap_mode)
        self.vertices = dr.ravel(
            dr.gather(mi.Vector2f, self.data.array, mi.UInt32(self.texels.source))
        )
        dr.eval(self.vertices)
        self.element_bytes = 4 * dr.width(self.vertices)
        self.lattice = self.texels
        if not self.aligned:
            clamped = self.wrap_mode == "clamp"
            rows, columns = (axis.inner_cells if clamped else axis.cells for axis in (y, x))
            self.lattice = Lattice(rows, columns, self.wrap_mode)

        self.levels = None
        self.lists = None
        if domain is None or not self.all_small(domain.largest):
            self.lists = self.make_lists()
        self.slopes = self.make_slopes() if self.masked else None

    def make_lists(self) -> QuadLists:
        """The lists of elements within :attr:`normal_reach`."""
        key = self.listed_roughness()[0], self.step, self.curved, self.normal_reach

        def make() -> QuadLists:
            return QuadLists(self.lattice, self.cached(self.build_lists, *key))

        return shared(self, make, "lists of elements", *key)

    def place_seeds(self, height: int, width: int) -> None:
        """Set what depends on the size of the map and on the step alone."""
        self.axes = x, y = SeedAxis(width, self.step), SeedAxis(height, self.step)
        self.map_cells, self.seeds = (x.cells, y.cells), x.seeds
        self.variance = (SIGMA_H / self.seeds) ** 2
        self.origin = tuple(0.5 / axis.cell - 0.5 for axis in self.axes)
        self.aligned = self.map_cells == (width, height)
        # Sorted by the side of the diagonal: elements with the same Jacobian are neighbours, and
        # :meth:`lobes` makes their distribution once.
        self.places = sorted(
            ((u, v) for v in y.places for u in x.places),
            key=lambda place: side_of_diagonal(*place),
        )
        self.anchors = self.places
        if self.aligned and self.curved:
            self.anchors = [ANCHORS[side_of_diagonal(*place)][0] for place in self.places]

    def make_slopes(self) -> MomentPyramid | None:
        if self.lists is None:
            return None

        def make() -> MomentPyramid:
            return MomentPyramid(
                self.data,
                self.wrap_mode,
                lambda m: list(slope_of(m)),
                spread=COVARIANCE,
                first=1,
                scale=COARSE,
                domain=self.domain,
            )

        return shared(self, make, "slopes of elements", self.domain)

    def slope_moments(self, query, active):
        x, y, xx, yy, xy = self.slopes.average(query, active)
        return mi.Vector2f(x, y), (xx, xy, yy)

    def areas_of_many(self, directions, query, active):
        """As the base class; by points of the map where the pyramid of moments is too coarse."""
        height, width, _ = self.data.shape
        kernel = query.texel_kernel("gaussian", height, width, self.wrap_mode)
        narrow = kernel.minor_variance < COARSE.narrowest(1) ** 2
        points = mean_over_points(
            self, kernel, directions, active & narrow, None, dr.square(self.sigma_r)
        )
        averages = super().areas_of_many(directions, query, active & ~narrow)
        return choose_areas(narrow, points, averages)

    def frame_at(self, u: mi.Point2f, active: mi.Bool) -> tuple:
        """The map's projected normal at a position (texels), and its derivatives; as
        :meth:`.TexelMesh.frame_at`."""
        column, row = floor_int(u.x), floor_int(u.y)
        rows, columns = self.texels.y, self.texels.x
        normals = self.corner_normals(rows.locate(row)[1], columns.locate(column)[1], active)
        return frame_in_quad(u.x - column, u.y - row, normals, 0.0)

    def prepare_for_lights(self) -> None:
        if self.levels is None:
            self.levels = Levels(self.data, self.wrap_mode)
        mean, median = (
            self.curved_variance(slope) for slope in (self.levels.slope, self.levels.median_slope)
        )
        flat = FLAT_SHARE * max(mean - median, MIN_SIGMA_R**2)
        # In steps of √2, so that small changes of the map keep it.
        listed = max(self.least_listed, 2 ** (round(log2(flat)) / 2))
        if (self.normal_reach, self.listed) != (LIGHT_REACH, listed):
            self.normal_reach, self.listed = LIGHT_REACH, listed
            if self.lists is not None:
                self.lists = self.make_lists()

    def all_small(self, sigma: float) -> bool:
        """Whether all footprints are small whose standard deviations are at most ``sigma``
        (texels): the round one of this size covers the most cells."""
        height, width, _ = self.data.shape
        largest = Footprint(
            mi.Point2f(0), mi.Vector2f(sigma / width, 0), mi.Vector2f(0, sigma / height)
        )
        return bool(dr.all(self.weigh(largest)[1]))

    # --------------------------------------------------------------------------------------------
    #  The elements
    # --------------------------------------------------------------------------------------------

    def corner_normals(self, row, column, active):
        """Projected normals n0…n3 at the corners of a stored quad of texels."""
        return self.texels.corner_values(self.vertices, row, column, active)

    def located(self, row, column, x, y):
        """The quad of texels that holds the position (``x``, ``y``) of a stored cell.

        Returns the row and the column of the stored quad, and the position x, y in the quad.
        """
        if self.aligned:
            return row, column, x, y
        column, x = self.axes[0].texel(column, x, self.wrap_mode)
        row, y = self.axes[1].texel(row, y, self.wrap_mode)
        return row, column, x, y

    def jacobian(self, normals, side):
        """The Jacobian J = ∂n/∂u of the mesh, per cell, on one side of a quad's diagonal; None if
        elements are flat."""
        if not self.curved:
            return None
        n0, n1, n2, n3 = normals
        along_x = interpolate(n1 - n0, n3 - n2, side) * self.axes[0].cell
        along_y = interpolate(n2 - n0, n3 - n1, side) * self.axes[1].cell
        return mi.Matrix2f(along_x.x, along_y.x, along_x.y, along_y.y)

    def elements(self, row, column, active):
        """The elements of a stored cell, in the order of ``places``.

        Of each element: the mesh's projected normal at its anchor, which is a position in the
        cell, and its Jacobian (``mi.Matrix2f``, per cell), None for a flat one.
        """
        row, column, *inside = self.located(row, column, *self.places[0])
        normals = self.corner_normals(row, column, active)
        if not self.aligned:
            jacobian = self.jacobian(normals, side_of_diagonal(*inside))
            return [(normal_at(normals, *inside), jacobian)]
        sides = [side_of_diagonal(*place) for place in self.places]
        jacobians = {side: self.jacobian(normals, side) for side in set(sides)}
        if not self.curved:
            return [(normal_at(normals, *place), None) for place in self.places]
        return [(normals[ANCHORS[side][1]], jacobians[side]) for side in sides]

    def lobes(self, kernel, query=None):
        roughness = Gaussian((), dr.square(self.sigma_r))
        turn = self.turn_per_cell(query) if query else None
        overlap = self.overlap(kernel)
        area = 1 / len(self.places)
        # These do not depend on the cell.
        whitened = [kernel.whitened(mi.Vector2f(*place)) for place in self.places]
        steps = [
            overlap.gain @ mi.Vector2f(*place) - mi.Vector2f(*place) + mi.Vector2f(*anchor)
            for place, anchor in zip(self.places, self.anchors, strict=True)
        ]

        def lobes(row, column, corner, active):
            white_corner, step = kernel.whitened(corner), overlap.gain @ corner
            distribution, of = roughness, None
            for k, (normal, jacobian) in enumerate(self.elements(row, column, active)):
                shift = None
                if jacobian is not None:
                    # The mean is s_i + J μ, with μ = −S T⁻¹ offset; J also leads from the anchor,
                    # where ``normal`` is taken, to the seed.
                    shift = -(jacobian @ (step + steps[k]))
                if turn is not None:
                    # The half vector at offset + μ, where the footprint sees the element.
                    place = mi.Vector2f(*self.places[k])
                    turned = turn @ (corner + place - step - overlap.gain @ place)
                    shift = -turned if shift is None else shift - turned
                if (jacobian is not None or turn is not None) and (
                    jacobian is not of or distribution is roughness
                ):
                    of = jacobian
                    distribution = overlap.normals(relative_jacobian(jacobian, turn), roughness)
                rho_squared = dr.squared_norm(white_corner + whitened[k])
                yield area, rho_squared, normal, shift, distribution

        return lobes

    def is_small(self, kernel, steps):
        return kernel.touched_quads() <= tuning().few_cells

    def sum_all(self, kernel, add, active, zero):
        return every_quad(self.lattice, kernel, add, active, zero)

    def element(self, x, y, active):
        cells, places = zip(
            *(axis.cell_of(seed) for axis, seed in zip(self.axes, (x, y), strict=True)),
            strict=True,
        )
        column, row = self.lattice.x.locate(cells[0])[1], self.lattice.y.locate(cells[1])[1]
        row, column, *inside = self.located(row, column, *places)
        normals = self.corner_normals(row, column, active)
        return normal_at(normals, *inside), self.jacobian(normals, side_of_diagonal(*inside))

    def draw_seed(self, position, random_x, random_y, active):
        offset = mi.Vector2f(*(axis.offset for axis in self.axes))
        x, mass_x = draw_neighbour((position.x - offset.x) * self.seeds, random_x)
        y, mass_y = draw_neighbour((position.y - offset.y) * self.seeds, random_y)
        place = mi.Vector2f(x, y) * (1 / self.seeds) + offset
        return x, y, place, mass_x * mass_y * (1 / LARGEST_SUM**2)

    def mass(self, kernel):
        x = (kernel.mean - mi.Vector2f(*(axis.offset for axis in self.axes))) * self.seeds
        scale = self.seeds**2
        variance_u, variance_v = dr.square(kernel.sigma_u), dr.square(kernel.sigma_v)
        return lattice_mass(
            mi.Vector2f(x),
            scale * variance_u,
            scale * kernel.shear * variance_v,
            scale * variance_v,
        )

    # --------------------------------------------------------------------------------------------
    #  The lists
    # --------------------------------------------------------------------------------------------

    def ellipses(self, row, column, active=True):
        """Ellipses of projected normals, one for each element of a stored cell, that hold its
        normals."""
        with dr.suspend_grad():
            return tuple(
                self.ellipse(normal, mi.Vector2f(place) - mi.Vector2f(anchor), jacobian)
                for (normal, jacobian), place, anchor in zip(
                    self.elements(row, column, active), self.places, self.anchors, strict=True
                )
            )

    def ellipse(self, normal, step, jacobian):
        """The ellipse of an element: centre and two conjugate radii. It bounds all normals within
        :attr:`normal_reach`. ``step`` leads from the element's anchor to its seed (cells)."""
        spread = ()
        if jacobian is not None:
            normal = normal + jacobian @ step
            sigma = sqrt(self.variance)
            spread = tuple(mi.Vector2f(jacobian[0, k], jacobian[1, k]) * sigma for k in (0, 1))
        radii = Gaussian(spread, dr.square(self.listed_roughness())).root()
        return normal, *(self.normal_reach * radius for radius in radii)

    def build_lists(self) -> dict[str, np.ndarray]:
        """The lists of cells, by normal."""
        blocks = BlocksOfEllipses(self.lattice, self.ellipses, len(self.places))
        allowed = BYTES_PER_CELL[len(self.places) > 1]
        return Builder(blocks, dr.detach(self.data.array), self.normal_bounds(), allowed).arrays()

    def normal_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The rectangle (lower, upper) that holds the ellipses of all cells, and a margin.

        The margin keeps the normals at the border of the ellipses inside of the grid of lists,
        even where the map is flat.
        """
        index = dr.arange(mi.UInt32, self.lattice.x.quads * self.lattice.y.quads)
        columns = mi.UInt32(self.lattice.x.count)
        boxes = map(BlocksOfEllipses.extent, self.ellipses(index // columns, index % columns))
        lower, upper = zip(*boxes, strict=True)
        margin = 1.5 * self.listed_roughness()
        lower, upper = reduce(dr.minimum, lower) - margin, reduce(dr.maximum, upper) + margin
        return tuple(
            np.array([extreme(v)[0] for v in bound], np.float32)
            for extreme, bound in ((dr.min, lower), (dr.max, upper))
        )

    # --------------------------------------------------------------------------------------------
    #  As a part of a scene
    # --------------------------------------------------------------------------------------------

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.Differentiable)
        callback.put("sigma_r", self.sigma_r, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check new values, and rebuild. Derivatives keep flowing to the parameters."""
        if keys and not {"data", "sigma_r"} & set(keys):
            return
        check_sigma_r(self.owner, self.sigma_r[0])
        self.normal_map = changed_map(self.data, self.wrap_mode, self.owner)
        self.changed = True
        self.build(self.domain)

    def parts(self) -> dict[str, int]:
        return {"map": map_bytes(self.normal_map), **super().parts()}

    def __repr__(self) -> str:
        height, width, _ = self.data.shape
        return (
            f"Elements[{width}×{height} texels, {self.wrap_mode}, "
            f"{'curved' if self.curved else 'flat'}, sigma_r={self.sigma_r[0]:g}, "
            f"step={self.step:g}, {self.nbytes / 2**20:.1f} MiB]"
        )


#: For each side of a quad's diagonal: the corner at which its elements are anchored, as a position
#: and as an index. From its normal, the side's Jacobian leads to all others.
ANCHORS = {0.0: ((0, 0), 0), 0.5: ((1, 0), 1), 1.0: ((1, 1), 3)}


def relative_jacobian(jacobian: mi.Matrix2f | None, turn: mi.Matrix2f | None) -> mi.Matrix2f:
    """J − H: the map's Jacobian relative to the half vector's turn (None for zero, both)."""
    if turn is None:
        return jacobian
    return -turn if jacobian is None else jacobian - turn


def side_of_diagonal(x, y):
    """0 where (``x``, ``y``) is in the first triangle of a quad, 1 in the second, ½ on the
    diagonal."""
    beyond = x + y - 1
    return dr.select(dr.abs(beyond) < 1e-5, 0.5, dr.select(beyond > 0, 1.0, 0.0))


def interpolate(first, second, share):
    """Linear interpolation: (1 − ``share``) ``first`` + ``share`` ``second``."""
    if isinstance(share, float) and share in (0, 1):
        return second if share else first
    return first + (second - first) * share


def normal_at(normals, x, y):
    """The mesh's normal at (``x``, ``y``) in a quad with these corner normals.

    The planes of the triangles (n0, n1, n2) and (n3, n2, n1) meet in a kink along the diagonal.
    """
    n0, n1, n2, n3 = normals
    kink = n3 - n2 - (n1 - n0)
    return n0 + (n1 - n0) * x + (n2 - n0) * y + kink * dr.maximum(x + y - 1, 0)


def check_sigma_r(owner: str, sigma_r: float) -> None:
    """Raise :class:`~.ParameterError` unless the roughness is within its bounds."""
    requirement = f"a number in [{MIN_SIGMA_R:g}, {MAX_SIGMA_R:g}]"
    check(MIN_SIGMA_R <= sigma_r <= MAX_SIGMA_R, owner, "sigma_r", requirement, sigma_r)
