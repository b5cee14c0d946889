"""The first, untuned versions of the exact manifold P-NDF: what later ones are measured against.

Both take the Gaussian kernel and a map that repeats with sides that are powers of two, and nothing
else. They share no code with ``glintbsdf.pndf``, so that a change there cannot move the baseline.
"""

from __future__ import annotations

from math import exp, pi

import drjit as dr
import mitsuba as mi
import numpy as np

EPSILON = 1e-6


def cross(a, b):
    return dr.fma(a.x, b.y, -(a.y * b.x))


def triangle_density(m, a, b, c, centre, value):
    """One triangle's part of Wu24 Eq. 5; ``value(l1, l2)`` is the kernel at these coordinates."""
    e1, e2 = b - a, c - a
    det = cross(e1, e2)
    tiny = dr.abs(det) < EPSILON
    r = (2 * EPSILON / (3 * 3**0.5)) ** 0.5
    a = dr.select(tiny, mi.Vector2f(centre.x, centre.y + r), a)
    e1 = dr.select(tiny, mi.Vector2f(-(0.75**0.5) * r, -1.5 * r), e1)
    e2 = dr.select(tiny, mi.Vector2f(0.75**0.5 * r, -1.5 * r), e2)
    det = dr.select(tiny, EPSILON, det)
    q = m - a
    l1, l2 = cross(q, e2) / det, cross(e1, q) / det
    inside = (l1 >= 0) & (l2 >= 0) & (l1 + l2 <= 1)
    return dr.select(inside, value(l1, l2) / dr.abs(det), 0)


class FirstVersion:
    """Isotropic Gaussian footprints of ``sigma`` texels at ``uv``."""

    def __init__(self, normals: np.ndarray) -> None:
        self.height, self.width, _ = normals.shape
        self.vertices = mi.Float(normals.ravel())

    def quad(self, m, i, j, corner, sigma, active):
        """Both triangles of the quad (i, j) of the map, ``corner`` away from the centre."""
        next_i, next_j = (i + 1) & (self.height - 1), (j + 1) & (self.width - 1)
        n0, n1, n2, n3 = (
            dr.gather(mi.Vector2f, self.vertices, mi.UInt32(row * self.width + column), active)
            for row in (i, next_i)
            for column in (j, next_j)
        )

        def kernel(offset):
            rho2 = dr.squared_norm(corner + offset) / (sigma * sigma)
            peak = 1 / (2 * pi * (1 - exp(-4.5)) * sigma * sigma)
            return dr.select(rho2 <= 9, peak * dr.exp(-0.5 * rho2), 0)

        centre = 0.5 * (n1 + n2)
        return triangle_density(
            m, n0, n1, n2, centre, lambda l1, l2: kernel(mi.Vector2f(l1, l2))
        ) + triangle_density(
            m, n3, n2, n1, centre, lambda l1, l2: kernel(mi.Vector2f(1 - l1, 1 - l2))
        )

    def texels(self, uv):
        return mi.Vector2f(uv.x * self.width - 0.5, uv.y * self.height - 0.5)


class PlainLoop(FirstVersion):
    """A loop over all quads in the footprint's box."""

    def eval(self, m, uv, sigma):
        mean = self.texels(uv)
        first, last = (mi.Vector2i(dr.floor(mean + sign * 3 * sigma)) for sign in (-1, 1))

        def body(i, j, density):
            corner = mi.Vector2f(j, i) - mean
            row, column = i & (self.height - 1), j & (self.width - 1)
            density = density + self.quad(m, row, column, corner, sigma, True)
            j = j + 1
            end = j > last.x
            return dr.select(end, i + 1, i), dr.select(end, first.x, j), density

        state = (mi.Int(first.y), mi.Int(first.x), dr.zeros(mi.Float, dr.width(uv)))
        return dr.while_loop(state, lambda i, j, density: i <= last.y, body)[2]


class FirstLists(FirstVersion):
    """Inverted lists: 48×48 uniform cells, 16×16 blocks, the footprint's bounding box of blocks."""

    CELLS, BLOCK = 48, 16

    def __init__(self, normals: np.ndarray) -> None:
        super().__init__(normals)
        reach = (2 * EPSILON / (3 * 3**0.5)) ** 0.5
        quads = [np.roll(normals, shift, (0, 1)) for shift in ((0, 0), (0, -1), (-1, 0), (-1, -1))]
        lower, upper = np.min(quads, 0) - reach, np.max(quads, 0) + reach
        self.lower = lower.min((0, 1))
        self.scale = self.CELLS / (upper.max((0, 1)) - self.lower) * 0.999999

        def cell(n):
            index = ((n - self.lower) * self.scale).astype(np.int32)
            return index.clip(0, self.CELLS - 1).reshape(-1, 2)

        first, last = cell(lower), cell(upper)
        extent = last - first + 1
        count = extent.prod(1)
        quad = np.repeat(np.arange(len(count), dtype=np.int32), count)
        k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        cells = (
            (first[quad, 1] + k // extent[quad, 0]) * self.CELLS
            + first[quad, 0]
            + k % extent[quad, 0]
        )
        self.blocks_x, self.blocks_y = self.width // self.BLOCK, self.height // self.BLOCK
        block = (quad // self.width // self.BLOCK) * self.blocks_x + quad % self.width // self.BLOCK
        blocks = self.blocks_x * self.blocks_y
        key = cells.astype(np.int64) * blocks + block
        self.entries = mi.UInt32(quad[np.argsort(key, kind="stable")])
        counts = np.bincount(key, minlength=self.CELLS**2 * blocks)
        self.offset = mi.UInt32(np.append(0, np.cumsum(counts)).astype(np.uint32))
        self.nbytes = 4 * (len(quad) + len(counts) + 1) + 8 * len(count)

    def eval(self, m, uv, sigma):
        mean = self.texels(uv)
        x, y = ((m[k] - float(self.lower[k])) * float(self.scale[k]) for k in range(2))
        active = (x >= 0) & (y >= 0) & (x < self.CELLS) & (y < self.CELLS)
        cell = (mi.UInt32(y) * self.CELLS + mi.UInt32(x)) * (self.blocks_x * self.blocks_y)
        first, last = (
            mi.Vector2i(dr.floor((mean + sign * 3 * sigma) / self.BLOCK)) for sign in (-1, 1)
        )

        def next_run(entry, end, block_x, block_y, origin, active):
            new_row = block_x > last.x
            block_y = dr.select(new_row, block_y + 1, block_y)
            block_x = dr.select(new_row, first.x, block_x)
            active = active & (block_y <= last.y)
            wrapped_x, wrapped_y = block_x & (self.blocks_x - 1), block_y & (self.blocks_y - 1)
            run = dr.minimum(last.x - block_x + 1, self.blocks_x - wrapped_x)
            index = cell + mi.UInt32(wrapped_y * self.blocks_x + wrapped_x)
            entry = dr.gather(mi.UInt32, self.offset, index, active)
            end = dr.gather(mi.UInt32, self.offset, index + mi.UInt32(run), active)
            return entry, end, block_x + run, block_y, (block_x - wrapped_x) * self.BLOCK, active

        def body(*state):
            *run, density = state
            run = dr.if_stmt(tuple(run), run[-1] & (run[0] >= run[1]), next_run, lambda *run: run)
            entry, end, block_x, block_y, origin, active = run
            found = active & (entry < end)
            quad = dr.gather(mi.UInt32, self.entries, entry, found)
            i, j = mi.Int(quad // self.width), mi.Int(quad % self.width)
            row = block_y * self.BLOCK + (i & (self.BLOCK - 1))
            corner = mi.Vector2f(origin + j, row) - mean
            density = density + dr.select(found, self.quad(m, i, j, corner, sigma, found), 0)
            return entry + 1, end, block_x, block_y, origin, active, density

        zero = dr.zeros(mi.Int, dr.width(uv))
        state = (
            mi.UInt32(zero),
            mi.UInt32(zero),
            last.x + 1,
            first.y - 1,
            zero + 0,
            active,
            mi.Float(zero),
        )
        return dr.while_loop(state, lambda *state: state[5], body)[6]
