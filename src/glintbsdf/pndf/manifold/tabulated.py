"""The manifold's P-NDF from tables: its cost does not grow with the footprint, its error is chosen.

For large footprints a lattice of nodes, B texels apart, replaces the map. Node k stands for the
texels around it, weighted by a function φ_k, which is a quadratic B-spline or close to one. The
functions of all nodes add up to one. For every node, a table holds the histogram M_k(bin) of the
normals under φ_k (:mod:`~glintbsdf.pndf.manifold.tables`). With the footprint's kernel interpolated
between the nodes,

    D(m) = Σ_k k(u_k − x) M_k(bin of m) / (B² Σ_k k(u_k − x) · area of a bin).

The sampler draws a node in proportion to k(u_k − x), a position with the density φ_k, and a
position in the bin of the normal there. This is exactly the density D, and needs no further tables.

*The error.* φ_k adds its own variance to the kernel, B²/4 per axis for a spline. So the footprint
is narrowed by this variance before. The remaining error is the difference of two kernels of equal
mass, mean and covariance. Its effect depends on the map and is measured when the tables are built
(:mod:`~glintbsdf.pndf.manifold.table_error`). The nodes of a level are 1⅓ to 1½ times as far apart
as the nodes of the level before. A footprint uses the coarsest level whose predicted error is
allowed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque
from glintbsdf.core.tuning import tuning
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import KERNELS, VARIANCE, TexelKernel
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf.base import register
from glintbsdf.pndf.manifold.exact import Manifold
from glintbsdf.pndf.manifold.mesh import normal_in_quad
from glintbsdf.pndf.manifold.table_error import MAX_NARROWING, largest_spacing, predicted_error
from glintbsdf.pndf.manifold.tables import MIN_SPACING, TWO_THIRDS, NormalTables


@register(
    "tables",
    title="manifold, tables",
    plugin="glint_manifold",
    options={"max_error": 0.05},
    settings={"max_error": 0.05},
)
class TabulatedManifold(Manifold):
    """The manifold, exact for small footprints and by tables for large ones.

    Other arguments are the same as in :class:`Manifold`.

    Args:
        max_error (float): largest relative L1 error of the P-NDF, > 0. It is an error of the masses
            in the bins of the tables, whose size is 1/128 of the range of the map's normals, and at
            least 1e-4. Within a bin D is constant, so the error in finer or shifted bins is larger.
            The predicted error is at most ``max_error``; :meth:`measured_error` is the true one.
            Footprints for which no level is accurate enough are evaluated exactly.
        domain: as in :class:`Manifold`; there are no tables where all footprints are exact.

    A map with ``wrap_mode`` ``clamp`` is always evaluated exactly. There is no blending between
    levels, which would cost twice as much: where a growing footprint goes from one level to the
    next, D jumps by less than ``max_error``.

    Raises:
        ParameterError: an argument is out of range.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        max_error: float = 0.05,
        owner: str = "TabulatedManifold",
        domain: Domain | None = None,
    ) -> None:
        check(
            max_error > 0 and np.isfinite(max_error),
            owner,
            "max_error",
            "a finite number > 0",
            max_error,
        )
        self.max_error = float(max_error)
        super().__init__(normal_map, kernel, epsilon, owner, domain)

    def build(self, domain: Domain | None = None) -> None:
        """Build lists and tables for queries within ``domain``, or load them from the cache."""
        super().build(domain)
        self.tables = None
        exact = self.stand_in is not None or self.normal_map.wrap_mode == "clamp"
        if not exact and self.may_use_tables():
            self.tables = NormalTables(
                self.cached(self.build_tables, self.epsilon),
                (self.lattice.y.quads, self.lattice.x.quads),
            )

    @property
    def known_tables(self) -> NormalTables:
        """The tables; it is an error to use them where there are none."""
        if self.tables is None:
            raise RuntimeError(f"{self.owner}: no tables have been built")
        return self.tables

    def build_tables(self) -> dict[str, np.ndarray]:
        """Build the arrays of the tables."""
        return NormalTables.build(self.lattice, self.effective_triangles, self.normal_bounds())

    def may_use_tables(self) -> bool:
        """Whether any footprint within the domain is wide enough for the smallest spacing of
        nodes."""
        if self.domain is None:
            return True
        closest = min(MIN_SPACING, max(self.lattice.y.quads, self.lattice.x.quads))
        return closest <= largest_spacing(self.kernel) * self.domain.largest

    def error(self, kernel: TexelKernel, level: int) -> mi.Float:
        """The relative L1 error predicted for a footprint's kernel and a level of the tables."""
        mean = dr.sqrt(kernel.sigma_u_given_v * kernel.sigma_v)
        tables = self.known_tables
        lengths = tables.correlation_lengths[level][KERNELS.index(self.kernel)]
        nodes = [opaque(mi.Float, x) for x in lengths], opaque(mi.Float, tables.spacing(level))
        minor = dr.sqrt(kernel.minor_variance)
        return predicted_error(self.kernel, *nodes, tables.mixed[level], minor, mean)

    def measured_error(self, footprint) -> float:
        """The relative L1 error under a single footprint, over all bins; this is slow.

        The reference rasterises all triangles into the bins, weighted by the kernel at the centre
        of their quad.
        """
        kernel, bins = self.texel_kernel(Query.of(footprint)), self.known_tables.bins
        (mean,) = np.array(mi.Vector2f(kernel.mean)).T
        reach = np.array(dr.ravel(mi.Vector2f(kernel.reach_u, kernel.reach_v)))
        first, last = (np.floor(mean + sign * reach).astype(int) for sign in (-1, 1))
        x, y = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        row, column = (v.ravel() for v in np.meshgrid(y, x, indexing="ij"))
        offset = mi.Vector2f(mi.Float(column), mi.Float(row)) + 0.5 - mi.Vector2f(*map(float, mean))
        weight = kernel.value(offset).numpy()
        touched, periods = weight > 0, self.known_tables.periods
        part_in_bin = bins.rasterize(
            self.effective_triangles, row[touched] % periods[0], column[touched] % periods[1]
        )
        truth = part_in_bin.T @ weight[touched].astype(np.float64)
        every_bin = bins.normal(dr.arange(mi.UInt32, len(truth)), mi.Vector2f(0.5))
        masses = self.eval(every_bin, footprint).numpy().astype(np.float64) * bins.area
        return float(np.abs(masses - truth / truth.sum()).sum())

    def level(self, query: Query | Footprint) -> mi.Int:
        """The coarsest level whose predicted error is allowed; −1 where there is none."""
        query = Query.of(query)
        return query.once((self, "level"), lambda: self.find_level(self.texel_kernel(query)))

    def find_level(self, kernel: TexelKernel) -> mi.Int:
        """Compute what :meth:`level` returns, for a kernel."""
        level = mi.Int(-1)
        for k, variances in enumerate(self.known_tables.variances):
            variance = opaque(mi.Float, max(variances))
            room = variance <= MAX_NARROWING * VARIANCE[self.kernel] * kernel.minor_variance
            fits = room & (self.error(kernel, k) <= self.max_error)
            level = dr.select(fits, k, level)
        return level

    def counts_of(self, level):
        """Number of nodes (``mi.Int``) of a level along y and along x."""
        index = mi.UInt32(dr.maximum(level, 0))
        return [
            dr.gather(mi.Int, n, index)
            for n in (self.known_tables.count_y, self.known_tables.count_x)
        ]

    def relative_error(self, query) -> mi.Float:
        """The relative L1 error predicted for the level that a query uses; 0 where it is exact."""
        query = Query.of(query)
        if self.tables is None:
            return mi.Float(0)
        kernel, used, error = self.texel_kernel(query), self.level(query), mi.Float(0)
        for level in range(len(self.tables.counts)):
            error = dr.select(used == level, self.error(kernel, level), error)
        return error

    def node_kernel(self, query: Query) -> TexelKernel:
        """The footprint's kernel on the lattice of its level, in units of the nodes' spacing.

        It is narrowed by the variance that the functions of the nodes add.
        """
        return query.once((self, "node kernel"), lambda: self.make_node_kernel(query))

    def make_node_kernel(self, query: Query) -> TexelKernel:
        """Compute what :meth:`node_kernel` returns."""
        tables, level = self.known_tables, self.level(query)
        nodes = [
            mi.Float(n) * opaque(mi.Float, 1 / p)
            for n, p in zip(self.counts_of(level), tables.periods, strict=True)
        ]
        index = mi.UInt32(dr.maximum(level, 0))
        added = (
            dr.select(level >= 0, dr.gather(mi.Float, v, index) * (-1 / VARIANCE[self.kernel]), 1)
            for v in (tables.variance_x, tables.variance_y)
        )
        height, width, _ = self.data.shape
        per_texel = mi.Vector2f(nodes[1], nodes[0])
        kernel = TexelKernel(
            self.kernel,
            query.footprint,
            opaque(mi.Float, height) * nodes[0],
            opaque(mi.Float, width) * nodes[1],
            self.normal_map.wrap_mode,
            tuple(added),
        )
        # The centres of texels are corners of quads; nodes are in the middle of their cells.
        kernel.mean -= 0.5 * per_texel
        return kernel

    def every_node(self, kernel, active, visit, *state):
        """Visit all nodes of a level under a kernel from :meth:`node_kernel`, row by row.

        Calls ``visit(nodes, *state)`` with a few nodes at a time; it returns the new ``state``.
        A node is ``(weight, y, x, active)``. The weight is k(u_k − x), and 0 where the node is not
        active. The indices ``y``, ``x`` (``mi.Int``) in the lattice do not wrap.
        """
        mean = mi.Vector2f(kernel.mean)

        def row(y):
            """First and last node of a row."""
            left, right = kernel.row_at(mi.Float(y) - mean.y)
            return mi.Int(dr.ceil(mean.x + left)), floor_int(mean.x + right)

        y = mi.Int(dr.ceil(mean.y - kernel.reach_v))
        bottom = floor_int(mean.y + kernel.reach_v)
        x, last = row(y)

        per_turn = tuning().nodes_per_turn

        def body(y, x, last, active, *state):
            # A few nodes at a time: to find the next row costs about as much as a node.
            nodes = []
            for step in range(per_turn):
                inside = active & (x + step <= last)
                weight = kernel.value(mi.Vector2f(x + step, y) - mean)
                nodes.append((dr.select(inside, weight, 0), y, x + step, inside))
            state = visit(nodes, *state)
            new_row = x + (per_turn - 1) >= last
            y = dr.select(new_row, y + 1, y)
            first, final = row(y)
            x, last = dr.select(new_row, first, x + per_turn), dr.select(new_row, final, last)
            return y, x, last, active & (y <= bottom), *state

        state = (y, x, last, mi.Bool(active) & (y <= bottom), *state)
        return symbolic_loop(state, lambda *state: state[3], body, "every node")[4:]

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), see :class:`Manifold`: piecewise constant over bins where tables are used."""
        if self.tables is None:
            return super()._eval(m, query, active)
        level = self.level(query)
        exact = super()._eval(m, query, active & (level < 0))

        tables, kernel = self.tables, self.node_kernel(query)
        row, found = tables.row(m, active & (level >= 0) & (dr.squared_norm(m) < 1))
        table = tables.table(mi.UInt32(dr.maximum(level, 0)), row, found)
        count_y, count_x = self.counts_of(level)

        def add(nodes, mass, total):
            # One addition to each state variable: only then Dr.Jit sees that the loop is a sum.
            masses, weights = mi.Float(0), mi.Float(0)
            for weight, y, x, active in nodes:
                y, x = (wrapped(*v) for v in ((y, count_y), (x, count_x)))
                counts = kernel.counts(weight, active)
                masses += weight * tables.value(table, y, x, counts)
                weights += weight
            return mass + masses, total + weights

        mass, total = self.every_node(kernel, found, add, mi.Float(0), mi.Float(0))
        return exact + dr.select(
            found & (total > 0), mass / (total * opaque(mi.Float, tables.bins.area)), 0
        )

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D."""
        exact = super()._sample(query, sample1, sample2, active)
        if self.tables is None:
            return exact
        return dr.select(self.level(query) < 0, exact, self.draw_table(query, sample2, active))

    def draw_table(self, query: Query, sample2: mi.Point2f, active: mi.Bool) -> mi.Vector2f:
        """Draw a projected normal from the tables: a node in proportion to its weight, a position
        under its spline, and a position in the bin of the normal there."""
        kernel, level = self.node_kernel(query), self.level(query)
        active = active & (level >= 0)

        # The sampler needs more than two random numbers: they are a hash of the two given.
        a, b = (dr.reinterpret_array(mi.UInt32, mi.Float(u)) for u in (sample2.x, sample2.y))
        randoms = [uniform(v) for stream in range(5) for v in pcg3d(a, b, mi.UInt32(stream))]
        choice, *of_nodes, l1, l2, bin_x, bin_y = randoms[:13]

        def pick(nodes, total, choice, at_y, at_x):
            """Weighted reservoir sampling with one random number, rescaled after each decision."""
            for weight, y, x, active in nodes:
                total = total + weight
                chance = weight / dr.select(total > 0, total, 1)
                taken = active & (choice < chance)
                choice = dr.select(taken, choice / chance, (choice - chance) / (1 - chance))
                choice = dr.clip(choice, 0, 1 - 2.0**-24)
                at_y, at_x = dr.select(taken, y, at_y), dr.select(taken, x, at_x)
            return total, choice, at_y, at_x

        _, _, *node = self.every_node(
            kernel, active, pick, mi.Float(0), choice, mi.Int(0), mi.Int(0)
        )
        quad = []
        finest = self.known_tables.counts[0]
        axes = zip(
            self.counts_of(level),
            node,
            (self.lattice.y, self.lattice.x),
            finest,
            (of_nodes[:4], of_nodes[4:]),
            strict=True,
        )
        for count, index, axis, fine, u in axes:
            # The function of a node is a spline, or a mixture of finer splines: draw one of these.
            fine = opaque(mi.Int, fine)
            between = 3 * count == 2 * fine
            index = dr.select(between, finer_node(index, u[3]), index)
            spacing = mi.Float(axis.count) / mi.Float(dr.select(between, fine, count))
            # A quadratic B-spline is the density of a sum of three uniform numbers.
            place = (mi.Float(index) - 1 + u[0] + u[1] + u[2]) * spacing
            quad.append(axis.locate(floor_int(place))[1])

        row, column = quad
        m = normal_in_quad(l1, l2, self.quad_normals(row, column, active), self.epsilon)
        index, _ = self.known_tables.bins.index(m)
        return self.known_tables.bins.normal(index, mi.Vector2f(bin_x, bin_y))

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        return {**super().parts(), "tables": 0 if self.tables is None else self.tables.nbytes}


def wrapped(index, count):
    """``index`` (``mi.Int``) modulo ``count``, as ``mi.UInt32``."""
    return mi.UInt32(index - floor_int((mi.Float(index) + 0.5) / mi.Float(count)) * count)


def finer_node(index, u):
    """Draw one of the finest nodes whose mixture is the function of the node ``index`` in the level
    with two thirds as many nodes, see ``TWO_THIRDS``."""
    left, nearest, _ = (weight / sum(TWO_THIRDS) for weight in TWO_THIRDS)
    step = dr.select(u < left, -1, dr.select(u < left + nearest, 0, 1))
    return ((3 * index) >> 1) + dr.select((index & 1) == 0, step, 1 - step)
