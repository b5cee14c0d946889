"""The P-NDF of position-normal Gaussian elements.

Yan, Hašan, Marschner and Ramamoorthi, "Position-Normal Distributions for Efficient Rendering of
Specular Microstructure" (2016), section 5. Seeds on a lattice of step h carry Gaussians in
position × normal space, flat (Eq. 12) or aligned with the map's curvature (Eq. 13); the P-NDF is
their mixture seen through the footprint (Eq. 11), in the stable form of
:mod:`~glintbsdf.gaussian_lobes`.

Beyond the paper: the mixture is divided by its mass under the footprint, in closed form, so that it
integrates to one; and the sampler draws from exactly this density.
"""

from __future__ import annotations

from math import ceil, exp, inf, pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cache import load_or_build
from ..errors import check
from ..gaussian_lobes import SIGMA_H, Gaussian, Overlap, lattice_mass
from ..hashing import pcg3d, uniform
from ..kernels import TexelKernel
from ..lattice import BLOCK, Lattice, floor_int
from ..normalmap import NormalMap
from .quad_lists import QuadLists, every_quad

#: Of the lists; part of their name in the cache.
VERSION = 1

#: Footprints that touch no more cells than this are summed cell by cell; larger ones use the lists.
FEW_CELLS = 25

#: Where an element's normals are cut, in standard deviations along its principal axes: 1.3e-4 of
#: its mass lie outside. Only what large footprints skip: small ones sum without a cut.
NORMAL_REACH = 4.0

#: Bounds of the roughness. Half vectors in float32 are 6e-8 apart: below 1e-7 there is only noise,
#: and determinants underflow from 1e-9 on.
MIN_SIGMA_R, MAX_SIGMA_R = 1e-8, 1.0

#: Seeds per cell along an axis, at most: the loop over those of a cell is unrolled.
MAX_SEEDS = 4

#: Attempts of the sampler, of which nine in ten succeed.
MAX_ATTEMPTS = 64


def position_reach(sigma: mi.Float) -> mi.Float:
    """Where the sum over elements is cut, as a Mahalanobis distance of N(0, T).

    ``sigma`` is the minor standard deviation of T, in steps. The mass inside of the cut is known in
    closed form, but for a ripple that falls with ``sigma``: this cut keeps it below 5e-4.
    """
    return dr.maximum(3.75 - 0.25 * dr.log2(sigma), 3)


class SeedAxis:
    """Seeds along one axis of a map of ``texels`` texels, about ``step`` texels apart.

    Seeds are grouped in cells. Where a whole number of steps makes a texel, a cell is the span
    between two texel centres, which all its seeds interpolate; else it is a step with one seed.
    The step is rounded so that a whole number of cells makes the map.

    Attributes:
        seeds (int): seeds per cell.
        cells (int): cells per map.
        cell (float): side of a cell, texels. Cell k begins k sides after the first texel's centre.
        offset (float): the first seed's place in a cell, in cells.
    """

    def __init__(self, texels: int, step: float) -> None:
        per_texel = round(1 / step)
        aligned = 1 <= per_texel <= MAX_SEEDS and abs(per_texel * step - 1) < 1e-6
        self.texels = texels
        self.seeds = per_texel if aligned else 1
        self.cells = texels if aligned else max(1, round(texels / step))
        self.cell = texels / self.cells
        # One seed to a texel or less: midway between texel centres, where bilinear interpolation
        # has no kink.
        self.offset = 0.5 / self.seeds if self.cell <= 1 else 0.5 / self.cell

    @property
    def inner_cells(self) -> int:
        """Cells of a clamped map: those that begin before its last texel's centre, and one."""
        return ceil((self.texels - 1) / self.cell) + 1

    def cell_of(self, seed: mi.Int) -> tuple[mi.Int, mi.Float]:
        """The cell of a seed, and the seed's place in it."""
        cell = floor_int((mi.Float(seed) + 0.5) * (1 / self.seeds))
        return cell, dr.fma(1 / self.seeds, mi.Float(seed - cell * self.seeds), self.offset)

    def texel(self, cell: mi.UInt32, place: mi.Float, wrap_mode: str) -> tuple[mi.Int, mi.Float]:
        """The quad of texels, as stored, that holds a place in a stored cell, and where."""
        clamped = wrap_mode == "clamp"
        position = (mi.Float(cell) - (BLOCK if clamped else 0) + place) * self.cell
        if clamped:  # the map is constant beyond its border
            position = dr.clip(position, -1, self.texels - 0.5)
        texel = dr.floor(position)
        return mi.Int(texel) + (BLOCK if clamped else 0), position - texel


class Mixture:
    """A P-NDF of Gaussian elements on a lattice of cells; what all kinds of them share.

    A subclass sets

    Attributes:
        lattice (Lattice): the cells, with ``map_cells`` (columns, rows) of them to a map.
        lists (QuadLists): the cells whose elements may show a normal.
        variance (float): of S, cells².
        sigma_r (mi.Float): standard deviation σ_r of the normals of a flat element.
        wrap_mode (str): what lies beyond the map.

    and implements the methods that raise ``NotImplementedError`` here.
    """

    #: Where the lattice of cells begins, in cells from where its first texel would have its centre.
    origin = (0.0, 0.0)

    def elements(self, row, column, active) -> list[tuple]:
        """The elements of a stored cell: each its place in the cell (``mi.Vector2f``), its area
        (cells), its normal s_i (``mi.Vector2f``) and its Jacobian per cell (``mi.Matrix2f``, or
        None for a flat one)."""
        raise NotImplementedError

    def mass(self, kernel: TexelKernel) -> mi.Float:
        """W: mass of all elements under the footprint, without a cut."""
        raise NotImplementedError

    def draw_seed(self, position, random_x, random_y, active) -> tuple:
        """Draw an element in proportion to its Gaussian at ``position`` (cells).

        Returns the indices of its seed, its place (cells), and the probability with which it is
        to be accepted.
        """
        raise NotImplementedError

    def element(self, x, y, active) -> tuple:
        """Normal and Jacobian of the seed with these indices."""
        raise NotImplementedError

    def kernel(self, footprint) -> TexelKernel:
        """N(0, T), which weighs the elements, in cells."""
        columns, rows = self.map_cells
        kernel = TexelKernel(
            "gaussian",
            footprint,
            rows,
            columns,
            self.wrap_mode,
            added=(self.variance, self.variance),
            reach=lambda sigma: position_reach(sigma * (SIGMA_H / sqrt(self.variance))),
        )
        kernel.mean = kernel.mean - mi.Vector2f(*self.origin)
        return kernel

    def overlap(self, kernel: TexelKernel) -> Overlap:
        """What the footprint sees of every element."""
        return Overlap(Gaussian((kernel.du, kernel.dv)), Gaussian(variance=self.variance))

    def normals(self, overlap: Overlap, jacobian, offset) -> tuple[mi.Vector2f, Gaussian]:
        """Mean, from s_i, and distribution about it of an element's normals under the footprint.

        ``offset`` (cells): from the footprint's centre to the element's.
        """
        roughness = Gaussian(variance=dr.square(self.sigma_r))
        if jacobian is None:
            return mi.Vector2f(0), roughness
        return jacobian @ overlap.mean(-offset), overlap.normals(jacobian, roughness)

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 11); 0 outside of it.

        ``footprint``: a :class:`~glintbsdf.footprint.Footprint`, in the UV space of the map.
        """
        kernel = self.kernel(footprint)
        overlap = self.overlap(kernel)
        active = mi.Bool(active) & (dr.squared_norm(m) < 1)
        few = kernel.touched_quads() <= FEW_CELLS

        def add(density, row, column, corner, active):
            total = mi.Float(0)
            for place, area, normal, jacobian in self.elements(row, column, active):
                offset = corner + place
                mean, distribution = self.normals(overlap, jacobian, offset)
                weight = area * kernel.value(offset)
                total = dr.fma(weight, distribution.eval(m - normal - mean), total)
            return density + dr.select(active, total, 0)

        density = every_quad(self.lattice, kernel, add, active & few)
        listed = active & ~few & self.lists.covers(m)
        density = density + self.lists.visit(m, kernel, add, listed)
        return density / self.mass(kernel)

    def sample(
        self, footprint, sample1: mi.Float, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with density D.

        An element is drawn in proportion to its mass N(d; 0, T) under the footprint: a point u of
        the footprint, then an element seen there, accepted such that the mass seen there, which
        differs from point to point, does not count. Then a normal of this element. The random
        numbers of all but the first point are a hash of the samples.

        A normal outside the disk is an invalid sample, as D is 0 there.
        """
        kernel = self.kernel(footprint)
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
            accepted = (second[2] < probability) & (kernel.value(offset) > 0)
            count = count + 1
            return count, x, y, offset, active & ~accepted & (count < MAX_ATTEMPTS)

        with dr.suspend_grad():
            count, x, y, offset, _ = dr.while_loop(
                (mi.UInt32(0), mi.Int(0), mi.Int(0), mi.Vector2f(0), mi.Bool(active)),
                lambda *state: state[-1],
                attempt,
                label="element",
            )
        normal, jacobian = self.element(x, y, active)
        mean, distribution = self.normals(self.overlap(kernel), jacobian, offset)
        random = pcg3d(bits[0], bits[1], bits[2] + 3 * count + 2)
        z = mi.warp.square_to_std_normal(mi.Point2f(uniform(random[0]), uniform(random[1])))
        return normal + mean + distribution.sample(mi.Vector2f(z))

    @property
    def nbytes(self) -> int:
        """Memory of elements and lists, bytes."""
        return self.element_bytes + self.lists.nbytes


def draw_neighbour(x, random):
    """Draw an integer k in proportion to N(x − k; 0, σ_h²).

    Returns k, and the sum of these densities over all k.
    """
    first = dr.floor(x) - 2
    # Six integers: what lies beyond weighs less than 1e-10.
    weights = [dr.exp((-0.5 / SIGMA_H**2) * dr.square(x - first - k)) for k in range(6)]
    total = sum(weights)
    left, k = random * total, mi.Float(0)
    for weight in weights[:-1]:
        left = left - weight
        k = k + dr.select(left >= 0, 1, 0)
    return mi.Int(first + k), total * (1 / (SIGMA_H * sqrt(2 * pi)))


#: The largest sum of :func:`draw_neighbour`, that at an integer.
DENSEST = sum(exp(-0.5 * (k / SIGMA_H) ** 2) for k in range(-3, 4)) / (SIGMA_H * sqrt(2 * pi))


class Elements(Mixture):
    """Elements of a normal map, and their exact sampler.

    Nothing is stored per element: its normal and Jacobian come from the four texels around it.
    Belongs to the variant of Mitsuba that is active when it is made.

    Args:
        normal_map (NormalMap): the map; between texel centres, normals are interpolated bilinearly.
        sigma_r (float): intrinsic roughness σ_r, the standard deviation of a projected normal.
        step (float): h, texels from one seed to the next. It is rounded so that a whole number of
            steps makes the map.
        curved (bool): whether elements follow the map's Jacobian (Eq. 13) or are flat (Eq. 12).
        owner (str): whom errors name, usually the plugin.

    Attributes:
        data (mi.TensorXf): the projected normals, H×W×2. Derivatives flow through it and through
            ``sigma_r``; after a change of values, :meth:`parameters_changed` rebuilds what depends
            on them.

    Raises :class:`~glintbsdf.errors.ParameterError`.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        sigma_r: float = 0.005,
        step: float = 0.5,
        curved: bool = True,
        owner: str = "Elements",
    ) -> None:
        check_sigma_r(owner, sigma_r)
        check(0 < step < inf, owner, "step", "a finite number > 0", step)
        self.normal_map, self.step, self.curved, self.owner = normal_map, step, curved, owner
        self.wrap_mode = normal_map.wrap_mode
        self.data = mi.TensorXf(normal_map.normals)
        self.sigma_r = mi.Float(sigma_r)
        key = f"elements {VERSION} {normal_map.content_hash} {sigma_r!r} {step!r} {curved}"
        self.build(lambda build: load_or_build(key, build))

    def build(self, cached=lambda build: build()) -> None:
        """Make everything that depends on ``data`` and ``sigma_r``."""
        height, width, _ = self.data.shape
        self.axes = SeedAxis(width, self.step), SeedAxis(height, self.step)
        x, y = self.axes
        self.map_cells = x.cells, y.cells
        self.seeds = x.seeds
        self.variance = (SIGMA_H / self.seeds) ** 2
        self.origin = tuple(0.5 / axis.cell - 0.5 for axis in self.axes)

        self.texels = Lattice(height, width, self.wrap_mode)
        if x.cells == width and y.cells == height:
            self.lattice = self.texels
        else:
            clamped = self.wrap_mode == "clamp"
            self.lattice = Lattice(
                *(axis.inner_cells if clamped else axis.cells for axis in (y, x)), self.wrap_mode
            )
        self.vertices = dr.ravel(
            dr.gather(mi.Vector2f, self.data.array, mi.UInt32(self.texels.source))
        )
        dr.eval(self.vertices)
        self.element_bytes = 4 * dr.width(self.vertices)
        self.lists = QuadLists(self.lattice, cached(self.build_lists))

    # --------------------------------------------------------------------------------------------
    #  The elements
    # --------------------------------------------------------------------------------------------

    def corner_normals(self, row, column, active):
        """Projected normals n0…n3 around a stored quad of texels."""
        return [
            dr.gather(mi.Vector2f, self.vertices, mi.UInt32(index), active)
            for index in self.texels.corners(row, column)
        ]

    def located(self, row, column, place):
        """The quad of texels (row, column) that holds a ``place`` in a stored cell, and where."""
        if self.lattice is self.texels:
            return row, column, place
        (x, y), (fx, fy) = self.axes, place
        column, fx = x.texel(column, fx, self.wrap_mode)
        row, fy = y.texel(row, fy, self.wrap_mode)
        return row, column, mi.Vector2f(fx, fy)

    def interpolated(self, normals, place):
        """The bilinear normal at a ``place`` in a quad, and its Jacobian per cell if curved."""
        n0, n1, n2, n3 = normals
        along_x, along_y, twist = n1 - n0, n2 - n0, n3 - n2 - (n1 - n0)
        across = along_x + twist * place.y
        normal = n0 + across * place.x + along_y * place.y
        if not self.curved:
            return normal, None
        x, y = self.axes
        along_x, along_y = across * x.cell, (along_y + twist * place.x) * y.cell
        return normal, mi.Matrix2f(along_x.x, along_y.x, along_x.y, along_y.y)

    def elements(self, row, column, active):
        x, y = self.axes
        places = [
            mi.Vector2f(x.offset + i / x.seeds, y.offset + j / y.seeds)
            for j in range(y.seeds)
            for i in range(x.seeds)
        ]
        area = 1 / len(places)
        row, column, _ = located = self.located(row, column, places[0])
        normals = self.corner_normals(row, column, active)
        if len(places) == 1:
            return [(places[0], area, *self.interpolated(normals, located[2]))]
        return [(place, area, *self.interpolated(normals, place)) for place in places]

    def element(self, x, y, active):
        cells, places = zip(
            *(axis.cell_of(seed) for axis, seed in zip(self.axes, (x, y), strict=True)),
            strict=True,
        )
        column, row = self.lattice.x.locate(cells[0])[1], self.lattice.y.locate(cells[1])[1]
        row, column, place = self.located(row, column, mi.Vector2f(*places))
        return self.interpolated(self.corner_normals(row, column, active), place)

    def draw_seed(self, position, random_x, random_y, active):
        offset = mi.Vector2f(*(axis.offset for axis in self.axes))
        x, mass_x = draw_neighbour((position.x - offset.x) * self.seeds, random_x)
        y, mass_y = draw_neighbour((position.y - offset.y) * self.seeds, random_y)
        place = mi.Vector2f(x, y) * (1 / self.seeds) + offset
        return x, y, place, mass_x * mass_y * (1 / DENSEST**2)

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

    def bounds(self, row, column, active=True):
        """A parallelogram of projected normals that holds all elements of a stored cell.

        Returns a corner and two edges (``mi.Vector2f``), along the principal axes of the mean
        element, cut at ``NORMAL_REACH``.
        """
        with dr.suspend_grad():
            elements = self.elements(row, column, active)
            edges = [mi.Vector2f(1, 0), mi.Vector2f(0, 1)]
            corner = mi.Vector2f(0)
            if self.curved:
                edges[0] = principal_axis(sum(jacobian for *_, jacobian in elements))
                edges[1] = mi.Vector2f(-edges[0].y, edges[0].x)
            for k, axis in enumerate(edges):
                lower, upper = mi.Float(inf), mi.Float(-inf)
                for _, _, normal, jacobian in elements:
                    variance = dr.square(self.sigma_r)
                    if jacobian is not None:
                        image = jacobian.T @ axis
                        variance = dr.fma(self.variance, dr.squared_norm(image), variance)
                    centre, reach = dr.dot(normal, axis), NORMAL_REACH * dr.sqrt(variance)
                    lower = dr.minimum(lower, centre - reach)
                    upper = dr.maximum(upper, centre + reach)
                corner = corner + lower * axis
                edges[k] = (upper - lower) * axis
            return corner, *edges

    def build_lists(self) -> dict[str, np.ndarray]:
        """The lists of cells by normal."""

        def triangles(row, column, active):
            corner, first, second = self.bounds(row, column, active)
            return (corner, first, second), (corner + first + second, -first, -second)

        lower, upper = self.extent()
        normals = self.data.numpy().reshape(-1, 2)
        return QuadLists.build(self.lattice, triangles, normals, (lower, upper))

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """The rectangle (lower, upper) that holds the bounds of all cells."""
        columns = self.lattice.x.quads
        index = dr.arange(mi.UInt32, columns * self.lattice.y.quads)
        corner, first, second = self.bounds(index // columns, index % columns)
        lower = corner + dr.minimum(first, 0) + dr.minimum(second, 0)
        upper = corner + dr.maximum(first, 0) + dr.maximum(second, 0)
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

    def parameters_changed(self, keys: list[str] = ()) -> None:
        """Check new values, and rebuild. Derivatives keep flowing to them."""
        if keys and not {"data", "sigma_r"} & set(keys):
            return
        check_sigma_r(self.owner, self.sigma_r[0])
        self.normal_map = NormalMap(self.data.numpy(), self.wrap_mode, self.owner)
        self.build()

    def __repr__(self) -> str:
        height, width, _ = self.data.shape
        return (
            f"Elements[{width}×{height} texels, {self.wrap_mode}, "
            f"{'curved' if self.curved else 'flat'}, sigma_r={self.sigma_r[0]:g}, "
            f"step={self.step:g}, {self.nbytes / 2**20:.1f} MiB]"
        )


def check_sigma_r(owner: str, sigma_r: float) -> None:
    """Raise :class:`~glintbsdf.errors.ParameterError` for a roughness that is not allowed."""
    requirement = f"a number in [{MIN_SIGMA_R:g}, {MAX_SIGMA_R:g}]"
    check(MIN_SIGMA_R <= sigma_r <= MAX_SIGMA_R, owner, "sigma_r", requirement, sigma_r)


def principal_axis(jacobian: mi.Matrix2f) -> mi.Vector2f:
    """The direction of normals along which ``jacobian`` spreads positions most."""
    rows = [mi.Vector2f(jacobian[i, 0], jacobian[i, 1]) for i in range(2)]
    difference = 0.5 * (dr.squared_norm(rows[0]) - dr.squared_norm(rows[1]))
    product = dr.dot(*rows)
    radius = dr.sqrt(dr.fma(difference, difference, product * product))
    # The eigenvector, from the row that does not cancel.
    axis = dr.select(
        difference >= 0,
        mi.Vector2f(difference + radius, product),
        mi.Vector2f(product, radius - difference),
    )
    length = dr.norm(axis)
    return dr.select(length > 0, axis / dr.select(length > 0, length, 1), mi.Vector2f(1, 0))
