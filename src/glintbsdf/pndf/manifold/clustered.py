"""The P-NDF of the position-normal manifold, approximated by clusters of triangles.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.2; the clusters themselves (Eq. 7 and 8) are in
:mod:`~glintbsdf.pndf.manifold.cluster_fit`. Under a footprint of radii r_x, r_y, a cluster may
replace its quads if its residual satisfies

    e^l ≤ r_x r_y τ.

The coarsest clusters that satisfy it are a *cut* through the tree of clusters. The paper walks down
the tree in every query. Here cuts are made when the map is loaded, for some values of r_x r_y τ: a
*ladder* of cuts. Each rung of the ladder has about a quarter as many elements, which are clusters
and single quads, as the one below. It has its own inverted lists
(:mod:`~glintbsdf.pndf.index.lists`), so that a query is one flat loop. A query uses the highest
rung whose value is at most its own r_x r_y τ. So the criterion holds for every cluster that it
meets, even if it would allow further ones.

Evaluation and sampling use the same rung, and so the same triangles. These tile the texel lattice.
So D integrates to 1, and samples have exactly the density D, at every setting.
"""

from __future__ import annotations

from math import isfinite

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.core.opaque import opaque, stored
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

#: Rung k of the ladder has at most RUNG^k times as many elements as there are quads. An element is
#: then 2^k quads wide on average. The side of the rung's blocks is BLOCK·2^k, and no element is
#: larger than a block.
RUNG = 0.25

#: The first rung that is made. With a quarter of the elements, on rough maps, a query is no faster
#: than with single quads, as larger triangles reach into more cells of normals. With a sixteenth it
#: is faster.
FIRST_RUNG = 2

#: Levels of clusters that a kernel looks through come in multiples of this.
LEVELS_AT_ONCE = 4

#: With the wrap mode clamp, the borders of the stored map are as wide as the largest block. This
#: block may be at most this share of the map.
BORDER = 1 / 16

#: Memory allowed to the lists of the first rung, bytes per element; twice as much on each further
#: rung. Higher rungs have few elements, but these reach far in the plane of normals.
BYTES_PER_ELEMENT = 120

#: Number of bits for the column in the first word of an element; the other bits are its level.
COLUMN_BITS = 27


# ------------------------------------------------------------------------------------------------
#  Cuts
# ------------------------------------------------------------------------------------------------


def on_cut(residuals: list[np.ndarray], threshold: float) -> list[np.ndarray]:
    """The clusters of each level 1, 2, … on the cut: the coarsest ones with e^l ≤ ``threshold``.

    ``residuals`` are the residuals of all levels that may be used, (rows, columns) each. There is
    no cluster across the border of the stored lattice, only its children inside. Returns an array
    of truth values for each level.
    """
    result = []
    covered = None  # by the cut, on the level above
    for residual in reversed(residuals):
        within = np.zeros(residual.shape, bool)
        if covered is not None:
            rows, columns = covered.shape
            within[: 2 * rows, : 2 * columns] = covered.repeat(2, 0).repeat(2, 1)
        allowed = residual <= threshold
        result.append(allowed & ~within)
        covered = allowed | within
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

    ``rungs`` is the number of the highest rung possible, ``limit`` the largest threshold of any
    query.
    """
    cuts: list[tuple[float, list, int]] = []
    for rung in range(FIRST_RUNG, rungs + 1):
        usable = residuals[: rung + SHIFT]
        threshold = smallest_threshold(quads, usable, quads * RUNG**rung, limit)
        if threshold is None:
            break
        # No query would use a rung below this one whose threshold is as high.
        cuts = [cut for cut in cuts if cut[0] < threshold]
        cuts.append((threshold, on_cut(usable, threshold), SHIFT + rung))
    return cuts


def elements_of(cut: list[np.ndarray], rows: int, columns: int, block: int):
    """The elements of a cut, block by block.

    Returns, for all elements, the column and the row of the upper left quad, and the level. The
    fourth array has the index of the first element of every block of side ``block``, and the total
    number at its end.
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
    """The lattice of quads over which clusters are made, and the index of each cluster.

    Attributes:
        x, y (LatticeAxis): columns and rows. With the wrap mode clamp, the borders are wider than
            the mesh's, see :data:`BORDER`.
        rungs (int): the highest rung of the ladder, 0 where the map is too small for any.
        levels (int): number of levels of clusters.
        shapes (list of pairs): rows and columns of whole clusters, by level; level 0 is the quads.
        first (list): index of the first cluster of each level, and the total number.
        surplus (int): the row of a quad here minus its row in the mesh; the same for columns.
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
        self.tables = [
            stored(mi.UInt32, np.array(values, np.uint32))
            for values in (self.first[:-1], *zip(*self.shapes, strict=True))
        ]
        self.surplus = block - BLOCK if wrap_mode == "clamp" else 0

    def cluster(self, row, column, level):
        """Index of the cluster of a level that holds a quad, and whether there is one.

        ``level``: a number ≥ 1, or one number per lane; where it is 0 the index has no meaning.
        """
        if isinstance(level, int):
            numbers = self.first[level], *self.shapes[level]
            first, rows, columns = (opaque(mi.UInt32, n) for n in numbers)
        else:
            first, rows, columns = (dr.gather(mi.UInt32, table, level) for table in self.tables)
        i, j = mi.UInt32(row) >> level, mi.UInt32(column) >> level
        return first + i * columns + j, (i < rows) & (j < columns)


class CellsOfRung(NormalCells):
    """The cells of normals of a rung, which may differ from lane to lane; see :class:`Ladder`."""

    def __init__(self, ladder: Ladder, rung, active) -> None:
        self.origin, self.pixels = ladder.origin, ladder.pixels
        self.divisions = dr.gather(mi.UInt32, ladder.divisions, rung, active)
        self.slab_of_x, self.cell_of_y = ladder.slab_of_x, ladder.cell_of_y
        self.begin = ladder.begin("slab_of_x", rung, active)

    def slab(self, x, active=True):
        """Index of the slab of ``x`` among the slabs of all rungs, as ``cell_of_y`` has them."""
        index = mi.UInt32(dr.clip(self.pixel(x, 0), 0, RESOLUTION - 1))
        return dr.gather(mi.UInt32, self.slab_of_x, self.begin + index, active)

    def cell(self, m, active=True):
        """Index of the slab of ``m`` among the slabs of all rungs, and of its cell in the slab."""
        slab = self.slab(m.x, active)
        return slab, self.cell_in_slab(slab, m.y, active)


class Ladder:
    """A ladder of cuts through the tree of clusters, with inverted lists for each cut.

    It is made of the arrays (NumPy) that :meth:`build` returns. With K rungs and N clusters, these
    are

    * ``thresholds`` (K): the smallest r_x r_y τ of queries that use the rungs 1…K. Rung 0 has no
      clusters. With K = 0 there are no further arrays;
    * ``residuals`` (N): residuals of the clusters of all levels in use, level by level;
    * ``normals`` (N, 4, 2): vertex normals of these clusters;
    * ``shifts`` (K): log2 of the side of the blocks;
    * ``lower``, ``upper`` (2), ``divisions`` (K): the rectangle of normals, and its cells;
    * ``elements`` (…, 2): two words per element, of column and level, and of the row; block by
      block;
    * ``first_of_row``: index of the first element of each row of blocks;
    * the arrays of :class:`~.QuadLists`. Their entries are indices among the elements of a row of
      blocks;
    * ``begin`` (K, …): where the part of each rung begins in the joined arrays (:attr:`JOINED`).
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
        self.residuals = stored(mi.Float, arrays["residuals"])
        self.entries, self.offset = Packed(arrays["entries"]), Packed(arrays["offset"])
        for name in ("start", "elements", "first_of_row", "slab_of_x", "cell_of_y"):
            setattr(self, name, stored(mi.UInt32, arrays[name].ravel()))
        self.allowed = stored(mi.Float, arrays["thresholds"])
        self.shifts = stored(mi.UInt32, arrays["shifts"])
        self.divisions, self.begins = (
            stored(mi.UInt32, arrays["divisions"]),
            stored(mi.UInt32, arrays["begin"].ravel()),
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
        """Index at which a rung's part of a joined array begins."""
        index = rung * len(self.JOINED) + self.JOINED.index(name)
        return dr.gather(mi.UInt32, self.begins, index, active)

    # --------------------------------------------------------------------------------------------
    #  Queries
    # --------------------------------------------------------------------------------------------

    def rung(self, allowed):
        """The rung for r_x r_y τ = ``allowed``; rung 0 has no clusters."""
        rung = mi.UInt32(0)
        for threshold in self.thresholds:
            rung = dr.select(allowed >= opaque(mi.Float, threshold), rung + 1, rung)
        return rung

    def level_at(self, row, column, rung, active):
        """Level of the element of the rung that holds a stored quad."""
        active = active & (rung > 0)
        allowed = dr.gather(mi.Float, self.allowed, rung - 1, active)
        largest = dr.gather(mi.UInt32, self.shifts, rung - 1, active)
        result = mi.UInt32(0)
        # The kernel looks through more levels than the map has, so that maps with some more or less
        # share it. Those that the map has not are masked.
        largest = dr.minimum(largest, opaque(mi.UInt32, self.levels))
        count = min(LEVELS_AT_ONCE * -(-self.levels // LEVELS_AT_ONCE), self.lattice.levels)
        for level in range(1, count + 1):
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
        # Slabs are numbered across all rungs; each has RESOLUTION entries of ``cell_of_y``.
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
        """Fit the clusters, choose the cuts, and build their lists.

        Args:
            normals: projected normals of the map, (H, W, 2).
            epsilon (float): smallest |det J|.
            limit (float): the largest r_x r_y τ of any query.
            triangles_of: function of the clusters' normals (N, 4, 2) that returns a function
                ``(row, column, level, active)``, which returns the two triangles of an element.
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
        points = stored(mi.Float, normals.astype(np.float32).ravel())
        entries = elements = slabs = 0
        rungs = []
        for _, cut, shift in cuts:
            blocks = BlocksOfElements(cut, rows, columns, shift, triangles)
            allowed = BYTES_PER_ELEMENT << (shift - SHIFT - FIRST_RUNG)
            lists = Builder(blocks, points, bounds, allowed).arrays()
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
        self.longest_list = int(np.diff(self.first[:: self.columns]).max())
        self.largest_entry = self.longest_list - 1
        self.triangles_of_element = triangles
        self.device_first = stored(mi.UInt32, self.first.astype(np.uint32))
        self.device_elements = stored(mi.UInt32, self.elements.ravel())

    def first_of(self, block_row, block_column, offset=0):
        """Index of the first element of a block, or of the one ``offset`` blocks further on."""
        index = block_row * self.columns + block_column + offset
        return dr.gather(mi.UInt32, self.device_first, index)

    def count(self, block_row, block_column):
        """Number of elements in a block."""
        return self.first_of(block_row, block_column, 1) - self.first_of(block_row, block_column)

    def shapes(self, block_row, block_column, index, active):
        """Whether the element with this index in a block exists, and its two triangles."""
        index = self.first_of(block_row, block_column) + index
        place = unpacked(self.device_elements, index, active)
        return active, self.triangles_of_element(*place, active)

    def entry(self, block_row, block_column, index):
        """The entry that stands in the lists for an element: its index in the row of blocks."""
        return self.first_of(block_row, block_column) + index - self.first_of(block_row, 0)


def unpacked(elements, index, active):
    """Row, column and level of an element."""
    word, row = dr.gather(mi.Vector2u, elements, index, active)
    return mi.Int(row), mi.Int(word & ((1 << COLUMN_BITS) - 1)), word >> COLUMN_BITS


# ------------------------------------------------------------------------------------------------
#  The P-NDF
# ------------------------------------------------------------------------------------------------


class ScaledKernel:
    """A kernel in units of ``side`` texels, without a new normalisation."""

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
    """P-NDF of a normal map by clusters of quads (section 4.2).

    A footprint of radii r_x, r_y (texels; 3σ for the Gaussian, 1.5σ for ``disk`` and ``box``) uses
    clusters with a residual e^l ≤ r_x r_y τ, see :func:`~.fit_clusters`. So in a cluster of
    r_x × r_y texels, normals may be displaced by a mean squared distance of τ (texels²); in a
    smaller one the distance may be larger. The error of the P-NDF grows with τ, but τ is no bound
    on it; ``python -m benchmarks error_vs_time`` measures it. Footprints of a few texels are exact,
    and so are maps smaller than 32 texels (512, with the wrap mode clamp).

    A cluster's triangle is replaced like a triangle of the map where its area on the disk is below
    ε/2, whatever its size in texels. So the highlight of a flat part of the map has the same size
    with and without clusters.

    Args:
        normal_map (NormalMap): the map.
        threshold (float): τ > 0.
        kernel, epsilon, owner: as in :class:`~.TexelMesh`.
        domain: as in :class:`~.Manifold`; clusters are always made for the whole map.

    Attributes:
        ladder (Ladder): the cuts; None where no footprint would use a cluster.
        data (mi.TensorXf): as in :class:`~.TexelMesh`.

    Raises:
        ParameterError: an argument is out of range.
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
        """Build lists and clusters, or load them from the cache; clusters are of the whole map."""
        super().build(domain)
        self.ladder = None
        if self.stand_in is not None:
            return
        self.make_vertices()
        height, width, _ = self.data.shape
        self.clusters = ClusterLattice(height, width, self.normal_map.wrap_mode)
        self.quad_vertices = dr.width(self.vertices) // 2
        vertices_of_quads = self.vertices

        def triangles_of(normals):
            self.vertices = dr.concat(
                [dr.detach(vertices_of_quads), stored(mi.Float, normals.ravel())]
            )
            return self.element_triangles

        # r_x r_y τ of the largest footprint, with the widest kernel.
        limit = self.threshold * (max(REACH.values()) * SIGMA_MAX) ** 2 * height * width

        def build_ladder() -> dict[str, np.ndarray]:
            return Ladder.build(self.clusters, self.data.numpy(), self.epsilon, limit, triangles_of)

        arrays = self.cached(build_ladder, self.epsilon, self.threshold)
        self.vertices = vertices_of_quads
        if len(arrays["thresholds"]):
            self.ladder = Ladder(self.clusters, arrays)
            normals = stored(mi.Float, arrays["normals"].ravel())
            self.vertices = dr.concat([mi.Float(vertices_of_quads), normals])

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
        else:  # the radii along the principal axes
            radii = REACH[self.kernel] ** 2 * kernel.sigma_u_given_v * kernel.sigma_v
        small = kernel.touched_quads() <= tuning().few_quads
        return dr.select(small, 0, self.ladder.rung(radii * self.threshold))

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
            # In units of its side an element is a quad, and |det J| is 4^l times as large.
            added = quad_density(
                m, corner / side, ScaledKernel(kernel, side), normals, self.epsilon, active
            )
            return density + dr.select(active, side * side * added, 0)

        exact = super()._eval(m, query, active & (rung == 0))
        return exact + self.ladder.visit(m, kernel, rung, add, active)

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D: the normal n^l at a position drawn from k.

        ``sample1`` is not used.
        """
        if self.ladder is None:
            return super()._sample(query, sample1, sample2, active)
        kernel = self.texel_kernel(query)
        u = kernel.mean + kernel.sample(sample2)
        x, y = floor_int(u.x), floor_int(u.y)
        row, column = self.clusters.y.locate(y)[1], self.clusters.x.locate(x)[1]
        level = self.ladder.level_at(row, column, self.rung(kernel), active)
        inside = (1 << mi.Int(level)) - 1  # mask of the bits of a column or row within the element
        side = dr.rcp(mi.Float(1 << level))
        l1 = ((u.x - x) + (column & inside)) * side
        l2 = ((u.y - y) + (row & inside)) * side
        normals = self.element_normals(row, column, level, active)
        return normal_in_quad(l1, l2, normals, self.epsilon)

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, exact and clustered, bytes."""
        return {**super().parts(), "clusters": 0 if self.ladder is None else self.ladder.nbytes}
