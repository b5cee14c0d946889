"""The manifold's P-NDF at a cost that does not grow with the footprint, to an error of choice.

For large footprints the map is condensed to a lattice of nodes, B texels apart. Node k stands for
the texels around it, weighed by a quadratic B-spline; the splines of all nodes add up to one. For
every node a table tells how the mass under its spline spreads over a grid of bins in the plane of
projected normals, M_k(bin) (:mod:`~glintbsdf.pndf.normal_tables`). Interpolating the footprint's
kernel between the nodes gives

    D(m) = Σ_k k(u_k − x) M_k(bin of m) / (B² Σ_k k(u_k − x) · area of a bin).

A sample takes a node with probability ∝ k(u_k − x), a place under its spline, the normal there, and
a place in that normal's bin: exactly this density, with no tables but M.

*The error.* A spline widens the kernel by the variance B²/4 per axis, which is taken off the
footprint's covariance beforehand; what is left is the difference of two kernels of equal mass, mean
and covariance. Its L1 norm bounds the relative L1 error of the P-NDF on bins as fine as the tables'
or coarser, whatever the map. The error itself is smaller, the more so the more independent places
of the map fall into a bin; how far apart these are is measured when the tables are built
(:func:`~glintbsdf.pndf.normal_tables.grains`). A footprint uses the coarsest level whose error,
predicted from the two, is allowed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cache import load_or_build
from ..errors import check
from ..hashing import pcg3d, uniform
from ..kernels import SIGMA_MIN, TexelKernel
from ..lattice import floor_int
from ..normalmap import NormalMap
from ..reach import Reach
from .manifold import Manifold, normal_in_quad
from .normal_tables import MIN_SPACING, NormalTables, kernel_error, narrowing

#: Largest share of a footprint's variance that the splines may add.
MAX_NARROWING = 0.6


class TabulatedManifold(Manifold):
    """The manifold, exact for small footprints, by tables beyond; arguments as for ``Manifold``.

    Args:
        max_error (float): relative L1 error of the P-NDF allowed, > 0, on the bins of the tables:
            1/128 of the range of the map's normals. The error predicted stays below; the one
            measured is 0.7 to 1.2 of it (``benchmarks/tables.py``), and up to 1.5 for kernels with
            an edge. Footprints so small that it would be larger are evaluated exactly.
        reach: as for :class:`Manifold`; there are no tables where all footprints are exact.

    A map with ``wrap_mode`` ``clamp`` is always evaluated exactly. The tables carry derivatives
    with respect to the footprint, none with respect to the map, on which they depend through areas
    of triangles clipped to bins. From exact to tables, and from level to level, densities change by
    less than ``max_error`` at a size of the footprint: there is no blending, which would cost both.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        max_error: float = 0.05,
        owner: str = "TabulatedManifold",
        reach: Reach | None = None,
    ) -> None:
        check(
            max_error > 0 and np.isfinite(max_error),
            owner,
            "max_error",
            "a finite number > 0",
            max_error,
        )
        self.max_error = float(max_error)
        key = f"tables {NormalTables.VERSION} {normal_map.content_hash} {epsilon!r}"
        self.cached_tables = lambda build: load_or_build(key, build)
        super().__init__(normal_map, kernel, epsilon, owner, reach)
        self.cached_tables = lambda build: build()

    def build(self) -> None:
        """Make everything that depends on ``self.data``; the cache may know lists and tables."""
        super().build()
        self.tables = None
        if self.normal_map.wrap_mode != "clamp" and self.may_use_tables():
            arrays = self.cached_tables(
                lambda: NormalTables.build(self.lattice, self.effective_triangles, self.bounds())
            )
            self.tables = NormalTables(arrays, (self.lattice.y.quads, self.lattice.x.quads))

    def may_use_tables(self) -> bool:
        """Whether any footprint within the reach has room for the closest nodes there could be."""
        if self.reach is None:
            return True
        closest = min(MIN_SPACING, max(self.lattice.y.quads, self.lattice.x.quads))
        return narrowing(closest, self.kernel) <= MAX_NARROWING * self.reach.largest**2

    def error(self, kernel: TexelKernel, level: int) -> mi.Float:
        """The relative L1 error predicted for a footprint's kernel and a level of the tables."""
        minor = dr.sqrt(kernel.minor_variance)
        mean = dr.sqrt(kernel.sigma_u_given_v * kernel.sigma_v)
        spacing, grain = self.tables.spacing(level), self.tables.grains[level]
        # Half of it comes from either axis.
        across = kernel_error(self.kernel, spacing * dr.rcp(minor))
        along = kernel_error(self.kernel, spacing * minor * dr.rcp(mean * mean))
        return 0.5 * (across + along) * grain * dr.rcp(grain + mean)

    def measured_error(self, footprint) -> float:
        """The relative L1 error under a single footprint, over all bins: a check, slow.

        The truth spreads every triangle over the bins, weighed by the kernel at its quad's centre.
        """
        kernel, bins = self.texel_kernel(footprint), self.tables.bins
        (mean,) = np.array(mi.Vector2f(kernel.mean)).T
        reach = np.array(dr.ravel(mi.Vector2f(kernel.reach_u, kernel.reach_v)))
        first, last = (np.floor(mean + sign * reach).astype(int) for sign in (-1, 1))
        x, y = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        row, column = (v.ravel() for v in np.meshgrid(y, x, indexing="ij"))
        offset = mi.Vector2f(mi.Float(column), mi.Float(row)) + 0.5 - mi.Vector2f(*map(float, mean))
        weight = kernel.value(offset).numpy()
        touched, periods = weight > 0, self.tables.periods
        spread = bins.spread(
            self.effective_triangles, row[touched] % periods[0], column[touched] % periods[1]
        )
        truth = spread.T @ weight[touched].astype(np.float64)
        every_bin = bins.normal(dr.arange(mi.UInt32, len(truth)), mi.Vector2f(0.5))
        masses = self.eval(every_bin, footprint).numpy().astype(np.float64) * bins.area
        return float(np.abs(masses - truth / truth.sum()).sum())

    def level(self, footprint) -> mi.Int:
        """The coarsest level of nodes that keeps the error, −1 where none does."""
        kernel = self.texel_kernel(footprint)
        level = mi.Int(-1)
        for k in range(self.tables.levels):
            fits = narrowing(self.tables.spacing(k), self.kernel) <= (
                MAX_NARROWING * kernel.minor_variance
            )
            level += dr.select(fits & (self.error(kernel, k) <= self.max_error), 1, 0)
        return level

    def lattice_of(self, level):
        """Distance and number of the nodes of a level: ``(spacing, count)`` for y and for x."""
        tables, index = self.tables, mi.UInt32(dr.maximum(level, 0))
        counts = (dr.gather(mi.Int, n, index) for n in (tables.count_y, tables.count_x))
        return [(p / mi.Float(n), n) for p, n in zip(tables.periods, counts, strict=True)]

    def node_kernel(self, footprint, level) -> TexelKernel:
        """The footprint's kernel, less the variance that the splines of a level add."""
        (spacing_y, _), (spacing_x, _) = self.lattice_of(level)
        added = tuple(
            dr.select(level >= 0, -narrowing(spacing, self.kernel), SIGMA_MIN**2)
            for spacing in (spacing_x, spacing_y)
        )
        height, width, _ = self.data.shape
        wrap_mode = self.normal_map.wrap_mode
        return TexelKernel(self.kernel, footprint, height, width, wrap_mode, added)

    def every_node(self, kernel, level, active, visit, *state):
        """Visit all nodes of a level under a kernel, row by row.

        ``visit(weight, y, x, active, *state)`` returns the new ``state``; the weight is k(u_k − x);
        the node's place in the lattice, ``y``, ``x`` (``mi.Int``), does not wrap.
        """
        (spacing_y, _), (spacing_x, _) = self.lattice_of(level)
        mean = mi.Vector2f(kernel.mean)

        def start(y):
            """First and last node of a row."""
            v = dr.fma(y, spacing_y, 0.5 * spacing_y - mean.y)
            left, right = kernel.row_extent(v, v)
            return (
                mi.Int(dr.ceil((mean.x + left) / spacing_x - 0.5)),
                floor_int((mean.x + right) / spacing_x - 0.5),
            )

        y = mi.Int(dr.ceil((mean.y - kernel.reach_v) / spacing_y - 0.5))
        bottom = floor_int((mean.y + kernel.reach_v) / spacing_y - 0.5)
        x, last = start(mi.Float(y))

        def body(y, x, last, active, *state):
            inside = active & (x <= last)
            place = mi.Vector2f(x, y) + 0.5
            weight = kernel.value(place * mi.Vector2f(spacing_x, spacing_y) - mean)
            weight = dr.select(inside, weight, 0)
            state = visit(weight, y, x, inside, *state)
            new_row = x >= last
            y = dr.select(new_row, y + 1, y)
            first, final = start(mi.Float(y))
            x, last = dr.select(new_row, first, x + 1), dr.select(new_row, final, last)
            return y, x, last, active & (y <= bottom), *state

        state = (y, x, last, mi.Bool(active) & (y <= bottom), *state)
        return dr.while_loop(
            state, lambda *state: state[3], body, max_iterations=-1, label="every node"
        )[4:]

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), see :meth:`Manifold.eval`: piecewise constant over bins where tables are used."""
        if self.tables is None:
            return super().eval(m, footprint, active)
        level = self.level(footprint)
        exact = super().eval(m, footprint, mi.Bool(active) & (level < 0))

        tables, kernel = self.tables, self.node_kernel(footprint, level)
        row, found = tables.row(m, mi.Bool(active) & (level >= 0) & (dr.squared_norm(m) < 1))
        table = tables.table(mi.UInt32(dr.maximum(level, 0)), row, found)
        (_, count_y), (_, count_x) = self.lattice_of(level)

        def add(weight, y, x, active, mass, total):
            y, x = (wrapped(*v) for v in ((y, count_y), (x, count_x)))
            value = tables.value(table, y, x, active & (weight > 0))
            return dr.fma(weight, value, mass), total + weight

        mass, total = self.every_node(kernel, level, found, add, mi.Float(0), mi.Float(0))
        return exact + dr.select(found & (total > 0), mass / (total * tables.bins.area), 0)

    def sample(
        self, footprint, sample1, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with the density that :meth:`eval` gives."""
        exact = super().sample(footprint, sample1, sample2, active)
        if self.tables is None:
            return exact
        level = self.level(footprint)
        return dr.select(level < 0, exact, self.sample_tables(footprint, level, sample2, active))

    def sample_tables(self, footprint, level, sample2, active) -> mi.Vector2f:
        """A node by its weight, a place under its spline, the normal there, a place in its bin."""
        kernel = self.node_kernel(footprint, level)
        active = mi.Bool(active) & (level >= 0)

        # More numbers than the two given are wanted: hashed from them.
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(u)) for u in (sample2.x, sample2.y)]
        randoms = [uniform(v) for stream in range(4) for v in pcg3d(*bits, mi.UInt32(stream))]
        choice, *of_spline, l1, l2, bin_x, bin_y = randoms[:11]

        def pick(weight, y, x, active, total, choice, at_y, at_x):
            """Weighted reservoir of one, the random number being stretched and used again."""
            total = total + weight
            chance = weight / dr.select(total > 0, total, 1)
            taken = active & (choice < chance)
            choice = dr.select(taken, choice / chance, (choice - chance) / (1 - chance))
            choice = dr.clip(choice, 0, 1 - 2.0**-24)
            return total, choice, dr.select(taken, y, at_y), dr.select(taken, x, at_x)

        _, _, *node = self.every_node(
            kernel, level, active, pick, mi.Float(0), choice, mi.Int(0), mi.Int(0)
        )
        quad = []
        for (spacing, _), index, axis, u in zip(
            self.lattice_of(level),
            node,
            (self.lattice.y, self.lattice.x),
            (of_spline[:3], of_spline[3:]),
            strict=True,
        ):
            # A quadratic B-spline is the distribution of a sum of three uniform numbers.
            place = (mi.Float(index) - 1 + u[0] + u[1] + u[2]) * spacing
            quad.append(axis.locate(floor_int(place))[1])

        m = normal_in_quad(l1, l2, self.quad_normals(*quad, active), self.epsilon)
        index, _ = self.tables.bins.index(m)
        return self.tables.bins.normal(index, mi.Vector2f(bin_x, bin_y))

    @property
    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        return {**super().parts, "tables": 0 if self.tables is None else self.tables.nbytes}


def wrapped(index, count):
    """``index`` (``mi.Int``) modulo ``count``, as ``mi.UInt32``."""
    return mi.UInt32(index - floor_int((mi.Float(index) + 0.5) / mi.Float(count)) * count)
