"""The P-NDF of the position-normal manifold, approximated by clusters of triangles.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.2. Under a footprint of radii r_x, r_y every cluster
may stand for its quads whose residual satisfies

    e^l ≤ r_x r_y τ,

the coarsest first: a *cut* through the tree of clusters. The paper walks down the tree in every
query. Here the cuts are made when the map is loaded, for a ladder of values of r_x r_y τ, each of
which leaves a quarter of the elements of the one before; every rung has inverted lists, as the
quads have them (:mod:`~glintbsdf.pndf.index.lists`), so that a query is one flat loop. A query uses
the highest rung whose value is not above its own r_x r_y τ: the criterion holds for every cluster
it meets, though it would allow others as well.

Evaluation and sampling use the same rung, hence the same triangles, which tile the texel lattice:
the mass is 1 and the density of samples exact at every setting.
"""

from __future__ import annotations

from math import isfinite

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.core.opaque import opaque
from glintbsdf.core.progress import progress
from glintbsdf.core.tuning import tuning
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.kernels import REACH, SIGMA_MAX
from glintbsdf.footprint.lattice import BLOCK, LatticeAxis, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf.base import register
from glintbsdf.pndf.index.lists import (
    RESOLUTION,
    SHIFT,
    Blocks,
    Builder,
    NormalCells,
    Packed,
    walk,
)
from glintbsdf.pndf.manifold.cluster_fit import fit_clusters
from glintbsdf.pndf.manifold.exact import Manifold
from glintbsdf.pndf.manifold.mesh import (
    equilateral,
    normal_in_quad,
    quad_density,
    triangles_of_quad,
)

#: Rung k of the ladder has at most this share, to the power k, of the quads' number of elements.
#: Its blocks have the side BLOCK·2^k, as its elements are 2^k wide on average; none of them is
#: larger than a block.
RUNG = 0.25

#: The first rung that is made. On rough maps, lists of a quarter of the elements take as long as
#: the lists of the quads, because larger triangles reach into more cells of normals: they would
#: bring an error for nothing. From a sixteenth on they are faster. Smooth maps reach higher rungs
#: at once.
FIRST_RUNG = 2

#: A map that goes on as its border does (clamp) is stored with borders as wide as the largest
#: block, which may be at most this share of the map.
BORDER = 1 / 16

#: Memory allowed for the lists of the first rung, bytes per element; twice as much on each further
#: one. Higher rungs have few elements, but these reach far in the plane of normals.
BYTES_PER_ELEMENT = 120

#: Bits of the first word of an element that hold its column; the level has the others.
COLUMN_BITS = 27


# ------------------------------------------------------------------------------------------------
#  Cuts
# ------------------------------------------------------------------------------------------------


def on_cut(residuals: list[np.ndarray], threshold: float) -> list[np.ndarray]:
    """Which clusters of each level 1, 2, … are on the cut: the coarsest with e^l ≤ ``threshold``.

    ``residuals``: the residuals of all levels that may be used, (rows, columns) each. A cluster
    that the border of the stored lattice would cut through does not exist: its children stand for
    themselves.
    """
    result = []
    taken = None  # by an ancestor
    for residual in reversed(residuals):
        within = np.zeros(residual.shape, bool)
        if taken is not None:
            within[: 2 * taken.shape[0], : 2 * taken.shape[1]] = taken.repeat(2, 0).repeat(2, 1)
        small = residual <= threshold
        result.append(small & ~within)
        taken = small | within
    return result[::-1]


def element_count(quads: int, cut: list[np.ndarray]) -> int:
    """Number of clusters and single quads on a cut through a lattice of ``quads``."""
    return quads - sum(int(on.sum()) * (4**level - 1) for level, on in enumerate(cut, 1))


def smallest_threshold(quads: int, residuals: list[np.ndarray], most: float, limit: float):
    """The smallest threshold ≤ ``limit`` whose cut has at most ``most`` elements, or None."""
    candidates = np.unique(np.concatenate([r.ravel() for r in residuals]))
    candidates = candidates[candidates <= limit]
    low, high = 0, len(candidates)
    while low < high:
        middle = (low + high) // 2
        if element_count(quads, on_cut(residuals, candidates[middle])) <= most:
            high = middle
        else:
            low = middle + 1
    return candidates[low] if low < len(candidates) else None


def choose_cuts(quads: int, residuals: list[np.ndarray], rungs: int, limit: float) -> list[tuple]:
    """The ladder: for each rung its threshold, its cut, and log2 of the side of its blocks.

    ``rungs`` is the highest that there may be, ``limit`` the largest threshold that matters.
    """
    cuts: list[tuple[float, list, int]] = []
    for rung in range(FIRST_RUNG, rungs + 1):
        usable = residuals[: rung + SHIFT]
        threshold = smallest_threshold(quads, usable, quads * RUNG**rung, limit)
        if threshold is None:
            break
        # Rungs that no query would use are left out: the next one has no higher threshold.
        cuts = [cut for cut in cuts if cut[0] < threshold]
        cuts.append((threshold, on_cut(usable, threshold), SHIFT + rung))
    return cuts


def elements_of(cut: list[np.ndarray], rows: int, columns: int, block: int):
    """The elements of a cut, block by block.

    Returns columns, rows and levels of their upper left quads, and the first element of every block
    of side ``block`` (one more, the number of all).
    """
    single = np.ones((rows, columns), bool)
    parts = []
    for level, on in enumerate(cut, 1):
        row, column = np.nonzero(on)
        parts.append((column << level, row << level, np.full(len(row), level)))
        covered = on.repeat(1 << level, 0).repeat(1 << level, 1)
        single[: covered.shape[0], : covered.shape[1]] &= ~covered
    row, column = np.nonzero(single)
    column, row, level = np.concatenate(
        [(column, row, np.zeros(len(row), np.int64)), *parts], axis=1
    )
    block_columns = -(-columns // block)
    number = row // block * block_columns + column // block
    order = np.argsort(number, kind="stable")
    counts = np.bincount(number, minlength=-(-rows // block) * block_columns)
    return column[order], row[order], level[order], np.append(0, np.cumsum(counts))


# ------------------------------------------------------------------------------------------------
#  The tree of clusters
# ------------------------------------------------------------------------------------------------


class ClusterLattice:
    """The quads over which clusters are made, and the place of each cluster among all.

    Attributes:
        x, y (LatticeAxis): columns and rows. Where the map is clamped, their borders are wider than
            those of the mesh, see :data:`BORDER`.
        rungs (int): the highest rung of the ladder, 0 where the map is too small for any.
        levels (int): number of levels of clusters.
        shapes (list of pairs): rows and columns of whole clusters, by level; level 0 is the quads.
        first (list): clusters of lower levels than each, and the number of all.
        surplus (int): a quad of the mesh has this more as row and column here.
    """

    def __init__(self, height: int, width: int, wrap_mode: str) -> None:
        side = min(height, width) * {"repeat": 1, "mirror": 2, "clamp": BORDER}[wrap_mode]
        rungs = int(side).bit_length() - 1 - SHIFT
        self.rungs = rungs if rungs >= FIRST_RUNG else 0
        block = BLOCK << self.rungs
        self.x, self.y = LatticeAxis(width, wrap_mode, block), LatticeAxis(height, wrap_mode, block)
        self.levels = self.rungs + SHIFT if self.rungs else 0
        self.shapes = [(self.y.quads >> k, self.x.quads >> k) for k in range(self.levels + 1)]
        self.first = [0, 0]
        for rows, columns in self.shapes[1:]:
            self.first.append(self.first[-1] + rows * columns)
        self.tables = [mi.UInt32(v) for v in (self.first[:-1], *zip(*self.shapes, strict=True))]
        self.surplus = block - BLOCK if wrap_mode == "clamp" else 0

    def cluster(self, row, column, level):
        """Index of the cluster that holds a quad, and whether there is one.

        ``level``: a number ≥ 1, or one per lane, where 0 gives no index.
        """
        if isinstance(level, int):
            numbers = self.first[level], *self.shapes[level]
            first, rows, columns = (opaque(mi.UInt32, n) for n in numbers)
        else:
            first, rows, columns = (dr.gather(mi.UInt32, table, level) for table in self.tables)
        i, j = mi.UInt32(row) >> level, mi.UInt32(column) >> level
        return first + i * columns + j, (i < rows) & (j < columns)


class CellsOfRung(NormalCells):
    """The cells of normals of one rung per lane, see :class:`Ladder`."""

    def __init__(self, ladder: Ladder, rung, active) -> None:
        self.origin, self.pixels = ladder.origin, ladder.pixels
        self.divisions = dr.gather(mi.UInt32, ladder.divisions, rung, active)
        self.slab_of_x, self.cell_of_y = ladder.slab_of_x, ladder.cell_of_y
        self.begin = ladder.begin("slab_of_x", rung, active)

    def slab(self, x, active=True):
        """Number of a slab among those of all rungs, which ``cell_of_y`` goes by."""
        index = mi.UInt32(dr.clip(self.pixel(x, 0), 0, RESOLUTION - 1))
        return dr.gather(mi.UInt32, self.slab_of_x, self.begin + index, active)

    def cell(self, m, active=True):
        """Index of the cell of ``m`` among those of all rungs, which ``start`` goes by."""
        slab = self.slab(m.x, active)
        return slab, self.cell_in_slab(slab, m.y, active)


class Ladder:
    """A ladder of cuts through the tree of clusters, with inverted lists for each.

    It is made of the arrays (NumPy) that :meth:`build` returns; there are K rungs:
        ``thresholds`` (K): the least r_x r_y τ of the queries that use the cuts 1…K; cut 0 has no
        clusters at all. Where K = 0, there is no other array;
        ``residuals`` (N): residuals of the clusters of all levels that are reached, level by level;
        ``normals`` (N, 4, 2): normals of these clusters;
        ``shifts`` (K): log2 of the side of the blocks;
        ``lower``, ``upper`` (2), ``divisions`` (K): the rectangle of normals, and its cells;
        ``elements`` (…, 2): column and level, and row, of the elements, block by block;
        ``first_of_row``: the first of each row of blocks;
        and the arrays of :class:`~.QuadLists`, whose entries are places among the elements of a row
        of blocks. The arrays of all rungs stand one after the other; ``begin`` (K, …) says where
        each begins.
    """

    start: mi.UInt32
    elements: mi.UInt32
    first_of_row: mi.UInt32
    slab_of_x: mi.UInt32
    cell_of_y: mi.UInt32

    JOINED = ("start", "offset", "entries", "elements", "first_of_row", "slab_of_x", "cell_of_y")

    def __init__(self, lattice: ClusterLattice, arrays: dict[str, np.ndarray]) -> None:
        self.lattice, self.thresholds = lattice, [float(t) for t in arrays["thresholds"]]
        self.levels = lattice.first.index(len(arrays["residuals"])) - 1
        self.residuals = mi.Float(arrays["residuals"])
        self.entries, self.offset = Packed(arrays["entries"]), Packed(arrays["offset"])
        for name in ("start", "elements", "first_of_row", "slab_of_x", "cell_of_y"):
            setattr(self, name, mi.UInt32(arrays[name].ravel()))
        self.allowed, self.shifts = mi.Float(arrays["thresholds"]), mi.UInt32(arrays["shifts"])
        self.divisions, self.begins = (
            mi.UInt32(arrays["divisions"]),
            mi.UInt32(arrays["begin"].ravel()),
        )
        lower = arrays["lower"]
        scale = (RESOLUTION / (arrays["upper"] - lower)).astype(np.float32)
        self.origin, self.pixels = (
            [opaque(mi.Float, float(x)) for x in values] for values in (lower, scale)
        )

    @property
    def nbytes(self) -> int:
        """Memory of lists and residuals, bytes."""
        words = (self.residuals, self.start, self.elements, self.first_of_row, self.slab_of_x,
                 self.cell_of_y)  # fmt: skip
        return self.entries.nbytes + self.offset.nbytes + 4 * sum(dr.width(v) for v in words)

    def begin(self, name: str, rung, active):
        """Where a rung's part of a joined array begins."""
        index = rung * len(self.JOINED) + self.JOINED.index(name)
        return dr.gather(mi.UInt32, self.begins, index, active)

    # --------------------------------------------------------------------------------------------
    #  Queries
    # --------------------------------------------------------------------------------------------

    def rung(self, allowed):
        """The rung for r_x r_y τ = ``allowed``; 0: no clusters."""
        rung = mi.UInt32(0)
        for threshold in self.thresholds:
            rung = dr.select(allowed >= opaque(mi.Float, threshold), rung + 1, rung)
        return rung

    def level_at(self, row, column, rung, active):
        """Level of the element of the rung to which a stored quad belongs."""
        active = active & (rung > 0)
        allowed = dr.gather(mi.Float, self.allowed, rung - 1, active)
        largest = dr.gather(mi.UInt32, self.shifts, rung - 1, active)
        result = mi.UInt32(0)
        for level in range(1, self.levels + 1):
            index, exists = self.lattice.cluster(row, column, level)
            exists = exists & active & (level <= largest)
            residual = dr.gather(mi.Float, self.residuals, index, exists)
            result = dr.select(exists & (residual <= allowed), level, result)
        return result

    def visit(self, m, kernel, rung, add, active) -> mi.Float:
        """Sum over all elements of a rung that may show ``m`` under the kernel.

        Calls ``add(density, row, column, level, corner, active)``, as ``QuadLists.visit`` does.
        """
        active = active & (rung > 0)
        rung = rung - 1
        cells = CellsOfRung(self, rung, active)
        active = active & cells.covers(m)
        slab, cell = cells.cell(m, active)
        divisions = cells.divisions
        # Slabs are numbered through all rungs, RESOLUTION entries of ``cell_of_y`` each.
        slab = slab - self.begin("cell_of_y", rung, active) // RESOLUTION
        shift = dr.gather(mi.UInt32, self.shifts, rung, active)
        columns = ((mi.UInt32(self.lattice.x.count) - 1) >> shift) + 2  # of the table of offsets
        start, offset, first_of_row = (
            self.begin(name, rung, active) for name in ("start", "offset", "first_of_row")
        )
        cell = slab * divisions + cell
        count = divisions * divisions

        def run_of(block_row, first, last, active):
            list_index = block_row * count + cell
            begin = dr.gather(mi.UInt32, self.start, start + list_index, active)
            place = offset + list_index * columns
            return tuple(begin + self.offset[place + k, active] for k in (first, last + 1))

        def element_of(entry, row, found):
            first = dr.gather(
                mi.UInt32, self.first_of_row, first_of_row + (mi.UInt32(row) >> shift), found
            )
            return unpacked(self.elements, first + self.entries[entry, found], found)

        return walk(self.lattice, mi.Int(shift), kernel, run_of, element_of, add, active)

    # --------------------------------------------------------------------------------------------
    #  Building
    # --------------------------------------------------------------------------------------------

    @classmethod
    def build(cls, lattice: ClusterLattice, normals: np.ndarray, epsilon: float, limit: float,
              triangles_of) -> dict[str, np.ndarray]:  # fmt: skip
        """Fit the clusters, choose the cuts, build their lists.

        ``normals`` (H, W, 2) are the map's; ``limit`` is the largest r_x r_y τ that can occur;
        ``triangles_of(normals)``, given the clusters' normals (N, 4, 2), returns a function of row,
        column, level and a mask that returns an element's two triangles.
        """
        rows, columns = lattice.y.quads, lattice.x.quads
        clusters, residuals = [], []
        if lattice.rungs:
            vertices = normals[lattice.y.source][:, lattice.x.source]
            with progress("Fitting clusters") as report:
                for fit in fit_clusters(vertices, epsilon, lattice.levels):
                    clusters.append(fit[0].reshape(-1, 4, 2))
                    residuals.append(fit[1])
                    report(len(clusters) / lattice.levels)
        cuts = choose_cuts(rows * columns, residuals, lattice.rungs, limit)
        if not cuts:
            return {"thresholds": np.empty(0, np.float32)}

        reached = max(level for _, cut, _ in cuts for level, on in enumerate(cut, 1) if on.any())
        clusters = np.concatenate(clusters[:reached])
        reach = equilateral(epsilon)[0][1] * 1.001
        normals = normals.reshape(-1, 2)
        bounds = (
            np.minimum(normals.min(0), clusters.min((0, 1))) - reach,
            np.maximum(normals.max(0), clusters.max((0, 1))) + reach,
        )
        triangles = triangles_of(clusters)
        entries = elements = slabs = 0
        rungs = []
        for _, cut, shift in cuts:
            blocks = BlocksOfElements(cut, rows, columns, shift, triangles)
            allowed = BYTES_PER_ELEMENT << (shift - SHIFT - FIRST_RUNG)
            lists = Builder(blocks, normals, bounds, allowed).arrays()
            lists["start"] += np.uint32(entries)
            lists["slab_of_x"] = lists["slab_of_x"].astype(np.uint32) + slabs
            lists["first_of_row"] = blocks.first[: -1 : blocks.columns] + elements
            lists["elements"] = blocks.elements
            rungs.append(lists)
            entries += len(lists["entries"])
            elements += len(lists["elements"])
            slabs += len(lists["cell_of_y"])
        return cls.joined(rungs) | {
            "thresholds": np.array([threshold for threshold, _, _ in cuts], np.float32),
            "shifts": np.array([shift for _, _, shift in cuts], np.uint32),
            "normals": clusters,
            "residuals": np.concatenate([r.ravel() for r in residuals[:reached]]),
            "lower": rungs[0]["lower"],
            "upper": rungs[0]["upper"],
        }

    @classmethod
    def joined(cls, rungs: list[dict]) -> dict[str, np.ndarray]:
        """The arrays of all rungs one after the other, and where each begins."""
        result = {"divisions": np.array([len(r["cell_of_y"]) for r in rungs], np.uint32)}
        begin = []
        for name in cls.JOINED:
            parts = [r[name].reshape(-1) if name != "elements" else r[name] for r in rungs]
            result[name] = np.concatenate(parts)
            begin.append(np.cumsum([0, *(len(part) for part in parts[:-1])]))
            if name not in ("offset", "entries"):
                result[name] = result[name].astype(np.uint32)
        return result | {"begin": np.stack(begin, 1).astype(np.uint32)}


class BlocksOfElements(Blocks):
    """The elements of a cut, block by block, for :class:`~.Builder`."""

    def __init__(self, cut, rows: int, columns: int, shift: int, triangles) -> None:
        column, row, level, self.first = elements_of(cut, rows, columns, 1 << shift)
        self.elements = np.stack([column | level << COLUMN_BITS, row], 1).astype(np.uint32)
        self.rows, self.columns = -(-rows >> shift), -(-columns >> shift)
        self.mean_count = len(column) / (self.rows * self.columns)
        self.largest_entry = np.diff(self.first[:: self.columns]).max()
        self.triangles_of_element = triangles
        self.device_first = mi.UInt32(self.first.astype(np.uint32))
        self.device_elements = mi.UInt32(self.elements.ravel())

    def first_of(self, block_row, block_column, offset=0):
        index = block_row * self.columns + block_column + offset
        return dr.gather(mi.UInt32, self.device_first, index)

    def count(self, block_row, block_column):
        """How many elements a block has."""
        return self.first_of(block_row, block_column, 1) - self.first_of(block_row, block_column)

    def shapes(self, block_row, block_column, index, active):
        """Whether the ``index``-th of a block exists, and its two triangles."""
        index = self.first_of(block_row, block_column) + index
        place = unpacked(self.device_elements, index, active)
        return active, self.triangles_of_element(*place, active)

    def entry(self, block_row, block_column, index):
        """What the lists say of the ``index``-th of a block: its place in the row of blocks."""
        return self.first_of(block_row, block_column) + index - self.first_of(block_row, 0)


def unpacked(elements, index, active):
    """Row, column and level of an element."""
    word, row = dr.gather(mi.Vector2u, elements, index, active)
    return mi.Int(row), mi.Int(word & ((1 << COLUMN_BITS) - 1)), word >> COLUMN_BITS


# ------------------------------------------------------------------------------------------------
#  The P-NDF
# ------------------------------------------------------------------------------------------------


class Scaled:
    """A kernel seen in units of ``side`` texels, not normalised."""

    def __init__(self, kernel, side) -> None:
        self.kernel, self.side = kernel, side

    def value(self, offset):
        return self.kernel.value(offset * self.side)


@register(
    "clusters",
    title="manifold, clusters",
    plugin="glint_manifold",
    options={"threshold": 0.004},
    settings={"threshold": 0.004},
)
class ClusteredManifold(Manifold):
    """P-NDF of a normal map by clusters of quads (section 4.2), and its exact sampler.

    A footprint of radii r_x, r_y (texels; 3σ for the Gaussian, 1.5σ for ``disk`` and ``box``) uses
    clusters with a residual e^l ≤ r_x r_y τ, see :func:`~.fit_clusters`.
    So τ is the mean squared distance (texels²) by which a cluster as large as the footprint's
    r_x × r_y may misplace a normal; smaller ones may do so more. It bounds no error of the P-NDF,
    which grows with it: see ``python -m benchmarks error_vs_time``. Footprints of a few texels are
    exact, and so are maps smaller than 32 texels (512, where the map is clamped).

    A cluster's triangle of an area below ε/2 on the disk, whatever its size in texels, is replaced
    like a triangle of the map: a flat part of the map keeps the size that its highlight has without
    clusters.

    Args:
        normal_map (NormalMap): the map.
        threshold (float): τ > 0.
        kernel, epsilon, owner: as for :class:`~.TexelMesh`.
        domain: as for :class:`~.Manifold`; clusters are made of the whole map
            all the same.

    Attributes:
        ladder (Ladder): the cuts; None where no footprint would use a cluster.
        data (mi.TensorXf): as in ``TexelMesh``.

    Raises :class:`~.ParameterError`.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        threshold: float,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        owner: str = "ClusteredManifold",
        domain: Domain | None = None,
    ) -> None:
        check(0 < threshold and isfinite(threshold), owner, "threshold", "a finite number > 0",
              threshold)  # fmt: skip
        self.threshold = float(threshold)
        super().__init__(normal_map, kernel, epsilon, owner, domain)

    def build(self, domain: Domain | None = None) -> None:
        """Make lists and clusters; the cache may know most of it. Clusters are always complete."""
        super().build(domain)
        self.ladder = None
        if self.stand_in is not None:
            return
        self.make_vertices()
        height, width, _ = self.data.shape
        self.clusters = ClusterLattice(height, width, self.normal_map.wrap_mode)
        self.quad_vertices = dr.width(self.vertices) // 2
        quads_alone = self.vertices

        def triangles_of(normals):
            self.vertices = dr.concat([dr.detach(quads_alone), mi.Float(normals.ravel())])
            return self.element_triangles

        # The largest footprint of the widest kernel.
        limit = self.threshold * (max(REACH.values()) * SIGMA_MAX) ** 2 * height * width

        def build_ladder() -> dict[str, np.ndarray]:
            return Ladder.build(self.clusters, self.data.numpy(), self.epsilon, limit, triangles_of)

        arrays = self.cached(build_ladder, self.epsilon, self.threshold)
        self.vertices = quads_alone
        if len(arrays["thresholds"]):
            self.ladder = Ladder(self.clusters, arrays)
            self.vertices = dr.concat([mi.Float(quads_alone), mi.Float(arrays["normals"].ravel())])

    def element_normals(self, row, column, level, active):
        """Normals n_0^l…n_3^l of an element: a cluster, or a quad of the map at level 0."""
        quad = level == 0
        surplus = self.clusters.surplus
        quad_row, quad_column = (
            dr.clip(i - surplus, 0, axis.count - 1) if surplus else i
            for i, axis in ((row, self.lattice.y), (column, self.lattice.x))
        )
        index = (
            opaque(mi.UInt32, self.quad_vertices) + 4 * self.clusters.cluster(row, column, level)[0]
        )
        return [
            dr.gather(
                mi.Vector2f, self.vertices, dr.select(quad, mi.UInt32(corner), index + k), active
            )
            for k, corner in enumerate(self.lattice.corners(quad_row, quad_column))
        ]

    def element_triangles(self, row, column, level, active):
        """The two effective triangles of an element, without derivatives."""
        with dr.suspend_grad():
            normals = self.element_normals(row, column, level, active)
            return triangles_of_quad(normals, self.epsilon)

    def rung(self, kernel):
        """The rung of the ladder for a kernel: the highest that its r_x r_y τ allows."""
        if self.kernel == "box":
            radii = kernel.half_u * kernel.half_v
        else:  # the principal ones, of a rotated footprint
            radii = REACH[self.kernel] ** 2 * kernel.sigma_u_given_v * kernel.sigma_v
        few = kernel.touched_quads() <= tuning().few_quads
        return dr.select(few, 0, self.ladder.rung(radii * self.threshold))

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk; 0 outside of it."""
        if self.ladder is None:
            return super()._eval(m, query, active)
        kernel = self.texel_kernel(query)
        rung = self.rung(kernel)
        active = active & (dr.squared_norm(m) < 1)

        def add(density, row, column, level, corner, active):
            normals = self.element_normals(row, column, level, active)
            side = mi.Float(1 << level)
            # In units of the side, where an element is a quad: |det J| is 4^l times that per texel.
            added = quad_density(
                m, corner / side, Scaled(kernel, side), normals, self.epsilon, active
            )
            return density + dr.select(active, side * side * added, 0)

        exact = super()._eval(m, query, active & (rung == 0))
        return exact + self.ladder.visit(m, kernel, rung, add, active)

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D: the normal n^l at a place drawn from k.

        ``sample1`` is not needed.
        """
        if self.ladder is None:
            return super()._sample(query, sample1, sample2, active)
        kernel = self.texel_kernel(query)
        u = kernel.mean + kernel.sample(sample2)
        x, y = floor_int(u.x), floor_int(u.y)
        row, column = self.clusters.y.locate(y)[1], self.clusters.x.locate(x)[1]
        level = self.ladder.level_at(row, column, self.rung(kernel), active)
        inside = (1 << mi.Int(level)) - 1  # of a column or row, the part that lies in the element
        side = dr.rcp(mi.Float(1 << level))
        l1 = ((u.x - x) + (column & inside)) * side
        l2 = ((u.y - y) + (row & inside)) * side
        normals = self.element_normals(row, column, level, active)
        return normal_in_quad(l1, l2, normals, self.epsilon)

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, exact and clustered, bytes."""
        return {**super().parts(), "clusters": 0 if self.ladder is None else self.ladder.nbytes}
