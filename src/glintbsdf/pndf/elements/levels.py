"""Merged elements: a pyramid of a map's Gaussian elements, for queries with a light's spread.

Under a light of some extent, the P-NDF is averaged over a spread of normals. A wide spread covers
nearly every element under a footprint and needs none of them in detail. So elements are merged,
level by level. An element of level ℓ is a Gaussian of the map's plane, about 2^ℓ texels wide. It
holds the mean of the normals there, their linear regression on position, and the covariance of the
residual. Merging keeps all moments up to the second. So the mean and the covariance of the normals
under every footprint are kept.

Gaussians have a two-scale relation: a Gaussian of variance S' is a sum of Gaussians of variance S
on a lattice, weighted by a Gaussian of variance S' − S. An element of the level below has mean s,
regression J, residual covariance Q, and lies at d from the merged element. The raw moments of the
merged element about its own position are then weighted sums of s, of J S + s dᵀ, and of
Q + J S Jᵀ + s sᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.loops import add_where, symbolic_loop
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel, difference_of_products
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.gaussian_elements import (
    SIGMA_H,
    Gaussian,
    Overlap,
    averaged_over_ellipse,
)
from glintbsdf.pndf.manifold.mesh import normal_in_quad

#: ρ² of the cut of elements, the squared Mahalanobis distance from the footprint's centre, where
#: the footprint spans a cell. The weight falls linearly to 0 over the width FADE, up to the cut.
CUT, FADE = 7.0, 2.0


def cut_at(sigma: mi.Float) -> mi.Float:
    """ρ² of the cut: farther out for a footprint that covers a few elements only.

    ``sigma``: minor standard deviation of the Gaussian that weights the elements, cells.
    """
    return CUT + 4 * dr.maximum(-dr.log2(sigma), 0)


def widening(cut: mi.Float) -> mi.Float:
    """Factor on the covariance of a Gaussian that is cut there: it then has the covariance that it
    has without a cut.

    ρ² is exponential with a mean of 2. The cut is the mean of sharp cuts at s in [cut − FADE, cut],
    of mass 1 − exp(−s/2) and of the partial mean 2 − (s + 2) exp(−s/2) of ρ².
    """
    inner, outer = dr.exp(-0.5 * (cut - FADE)), dr.exp(-0.5 * cut)
    mass = 1 - (inner - outer) * (2 / FADE)
    partial = 2 - ((cut - FADE + 4) * inner - (cut + 4) * outer) * (2 / FADE)
    return 2 * mass / partial


#: The level of a query is the coarsest at which a footprint's minor standard deviation spans about
#: this many cells,
CELLS_PER_SIGMA = 3.0

#: and the normals change by about this multiple of the light's spread from cell to cell,
NORMALS_PER_SPREAD = 2.0

#: but a footprint's minor standard deviation spans no more cells than this.
MOST_CELLS_PER_SIGMA = 5.0

#: Reach of the Gaussian that merges elements, on each side of its centre, in standard deviations.
MERGE_REACH = 4.0

#: D counts as 0 beyond this many standard deviations from the bounds of the map's normals.
MARGIN = 4.5

#: An element counts as 0 beyond this squared Mahalanobis distance, in the covariance of element and
#: light together. exp(−16/2) = 3e-4 of a Gaussian lies beyond, and nothing of a wide light.
LIGHT_CUT = 16.0

#: Variance added to the residual covariance of merged elements, well above its rounding errors.
ROUNDING = 1e-7

#: The median is taken of this many texels.
MEDIAN_TEXELS = 1 << 16

#: Indices of the components of a symmetric 2×2 matrix.
PAIRS = (0, 0), (0, 1), (1, 1)

#: Elements of a row that one step of the loop adds.
UNROLLED = 2

#: Floats per element: 2 of the mean, 4 of the Jacobian, and xx and yy of the residual covariance.
#: Its xy is in an array of its own, as gathers of 8 floats are fast.
NUMBERS = 8

#: Nodes of Gauss and Hermite's rule along an axis of the mesh, for the Gaussian of a texel: the
#: corner of the quad relative to the texel before, and the place in the quad; and their weights.
NODES = (0, 1 - sqrt(3) * SIGMA_H), (1, 0.0), (1, sqrt(3) * SIGMA_H)
WEIGHTS = 1 / 6, 2 / 3, 1 / 6


@dataclass
class RawMoments:
    """Raw moments of the elements of a level, about their own positions (arrays of rows × columns).

    Attributes:
        n (list of 2): means of the projected normals.
        nx, ny (lists of 2): means of normal times offset along x and y (texels).
        nn (list of 3): means of the products xx, xy, yy of the normals.
        counts (pair, x first): elements along each axis.
        spacing (pair, x first): texels from one element to the next.
    """

    n: list
    nx: list
    ny: list
    nn: list
    counts: tuple[int, int]
    spacing: tuple[float, float]


class Levels:
    """The pyramid of merged elements of a map, from one element per texel up to a single one.

    Args:
        data (mi.TensorXf): projected normals, H×W×2; derivatives flow through it.
        wrap_mode (str): how the map continues beyond its border.

    Attributes:
        slope (float): standard deviation of the normals within a texel's Gaussian, over the map.
        median_slope (float): the same of the median texel. It is far below ``slope`` if most of the
            map is flat between edges.
        lower, upper (mi.Vector2f): bounds of the map's normals.
        nbytes (int): memory, bytes.
    """

    def __init__(self, data: mi.TensorXf, wrap_mode: str) -> None:
        height, width, _ = data.shape
        self.wrap_mode = wrap_mode
        base = finest_level(data, wrap_mode)
        variance = sum(dr.mean(x * x + y * y) for x, y in (base.nx, base.ny))
        self.slope = max(float(np.sqrt(variance[0])) / SIGMA_H, 1e-12)
        self.median_slope = float(np.sqrt(median_square(*base.nx, *base.ny))) / SIGMA_H
        x, y = base.n
        self.lower, self.upper = (
            mi.Vector2f(dr.detach(extreme(x)), dr.detach(extreme(y)))
            for extreme in (dr.min, dr.max)
        )

        tables: list[mi.Float] = []
        products: list[mi.Float] = []
        sizes, offsets, raw = [], [], base
        while not tables or max(raw.counts) > 1:
            if tables:
                raw = merged(merged(raw, 0, wrap_mode), 1, wrap_mode)
            offsets.append(sum(len(t) for t in tables) // NUMBERS)
            table, product = elements_of(raw)
            tables.append(table)
            products.append(product)
            sizes.append(raw.counts)
        self.count = len(tables)
        self.table = dr.concat(tables) if self.count > 1 else tables[0]
        self.products = dr.concat(products) if self.count > 1 else products[0]
        self.columns = mi.Int([size[0] for size in sizes])
        self.rows = mi.Int([size[1] for size in sizes])
        self.offsets = mi.UInt32(offsets)
        self.texels = mi.Vector2f(width, height)
        dr.make_opaque(self.columns, self.rows, self.offsets, self.lower, self.upper, self.texels)
        dr.eval(self.table, self.products)
        self.nbytes = 4 * (dr.width(self.table) + dr.width(self.products))

    def level_for(self, kernel: TexelKernel, spread: mi.Float) -> mi.UInt32:
        """Index of the level that answers a query, the coarsest that footprint and spread allow.

        Args:
            kernel: the footprint, in texels.
            spread: standard deviation of the light's spread of projected normals.
        """
        sigma = dr.sqrt(kernel.minor_variance)
        by_spread = spread * dr.opaque(mi.Float, NORMALS_PER_SPREAD / self.slope)
        cell = dr.maximum(
            dr.minimum(sigma * (1 / CELLS_PER_SIGMA), by_spread), sigma * (1 / MOST_CELLS_PER_SIGMA)
        )
        level = dr.round(dr.log2(cell))
        return mi.UInt32(dr.clip(level, 0, self.count - 1))

    def eval(
        self,
        m: mi.Vector2f,
        query: Query,
        variance: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """The density of the projected normal ``m``.

        Args:
            query: the query; its footprint is in the UV space of the map.
            variance: intrinsic roughness σ_r², the variance of each component of a flat element.
        """
        footprint, turn = query.footprint, query.turn
        height, width = self.texels.y, self.texels.x
        kernel = TexelKernel("gaussian", footprint, height, width, self.wrap_mode, (0.0, 0.0))
        light = Gaussian(query.spread)
        widest = dr.sqrt(dr.maximum(light.xx, light.yy) + variance)
        level = self.level_for(kernel, dr.sqrt(dr.sqrt(light.determinant) + variance))
        columns = dr.gather(mi.Int, self.columns, level, active)
        rows = dr.gather(mi.Int, self.rows, level, active)
        offset = dr.gather(mi.UInt32, self.offsets, level, active)

        size = mi.Vector2f(columns, rows)
        cells = kernel.minor_variance * (size.x * size.y / (width * height))
        cut = cut_at(dr.sqrt(cells + SIGMA_H**2))
        wide = widening(cut)
        root = dr.sqrt(wide)
        axes = [axis * root for axis in (footprint.du, footprint.dv)]
        kernel = TexelKernel(
            "gaussian",
            Footprint(footprint.uv, *axes),
            size.y,
            size.x,
            self.wrap_mode,
            (wide * SIGMA_H**2, wide * SIGMA_H**2),
        )
        kernel.cut_at(dr.sqrt(cut))
        axes = tuple(axis / root for axis in (kernel.du, kernel.dv))
        overlap = Overlap(Gaussian(axes), Gaussian(variance=SIGMA_H**2))
        if turn is not None:  # per cell
            turn = mi.Matrix2f(
                turn[0, 0] / size.x, turn[0, 1] / size.y, turn[1, 0] / size.x, turn[1, 1] / size.y
            )
            turn_x, turn_y = (mi.Vector2f(turn[0, k], turn[1, k]) for k in (0, 1))

        margin = MARGIN * widest
        if turn is not None:
            # The half vector turns this far over the footprint.
            turned = [dr.squared_norm(turn @ v) for v in (kernel.du, kernel.dv)]
            margin = margin + dr.sqrt(cut * (turned[0] + turned[1]))
        active = mi.Bool(active) & dr.all((m > self.lower - margin) & (m < self.upper + margin))

        mean = mi.Vector2f(kernel.mean)
        bottom = floor_int(mean.y + kernel.reach_v)

        def row(y):
            left, right = kernel.row_at(mi.Float(y) - mean.y)
            return -floor_int(-mean.x - left), floor_int(mean.x + right)

        def add(x, y, start, flip_y, inside, density, mass):
            d = mi.Vector2f(x, y) - mean
            rho_squared = dr.squared_norm(kernel.whitened(d))
            weight = dr.clip((cut - rho_squared) * (1 / FADE), 0, 1)
            weight = dr.select(inside, weight * dr.exp(-0.5 * rho_squared), 0)
            column, flip_x = wrapped(x, columns, self.wrap_mode)
            index = start + mi.UInt32(column)
            e = dr.gather(mi.ArrayXf, self.table, index, inside, shape=(NUMBERS, 1))
            product = dr.gather(mi.Float, self.products, index, inside)
            normal = mi.Vector2f(e[0], e[1])
            along_x, along_y = mi.Vector2f(e[2], e[3]) * flip_x, mi.Vector2f(e[4], e[5]) * flip_y
            if turn is not None:
                normal = normal - turn @ d
                along_x, along_y = along_x - turn_x, along_y - turn_y
            # Q + J C Jᵀ, and the roughness that all elements have in common
            a, b = (along_x * c.x + along_y * c.y for c in overlap.root)
            xx = variance + e[6] + dr.fma(a.x, a.x, b.x * b.x)
            xy = product + dr.fma(a.x, a.y, b.x * b.y)
            yy = variance + e[7] + dr.fma(a.y, a.y, b.y * b.y)
            step = overlap.mean(d)
            delta = m - normal + along_x * step.x + along_y * step.y
            determinant = difference_of_products(xx, yy, xy, xy)
            form = form_of_adjoint(xx, xy, yy, delta)
            if query.spread:
                mixed = xx * light.yy + yy * light.xx - 2 * xy * light.xy
                of_light = form_of_adjoint(light.xx, light.xy, light.yy, delta)
                near = form + of_light < LIGHT_CUT * (determinant + mixed + light.determinant)
                # The rays of a pixel agree on what is near, so far elements are skipped
                seen = add_where(
                    mi.Float(0),
                    near,
                    lambda: averaged_over_ellipse(
                        (determinant, mixed, light.determinant), (form, of_light)
                    ),
                    inside,
                )
            else:
                inverse_root = dr.rsqrt(determinant)
                seen = inverse_root * (1 / (2 * pi))
                seen = seen * dr.exp(-0.5 * form * dr.square(inverse_root))
            return dr.fma(weight, seen, density), mass + weight

        def body(x, right, y, active, density, mass):
            line, flip_y = wrapped(y, rows, self.wrap_mode)
            start = offset + mi.UInt32(line * columns)
            for k in range(UNROLLED):
                inside = active & (x + k <= right)
                density, mass = add(x + k, y, start, flip_y, inside, density, mass)

            done = x + UNROLLED > right
            y = dr.select(done, y + 1, y)
            left, new_right = row(y)
            x = dr.select(done, left, x + UNROLLED)
            right = dr.select(done, new_right, right)
            return x, right, y, active & (y <= bottom), density, mass

        top = -floor_int(-mean.y + kernel.reach_v)
        left, right = row(top)
        *_, density, mass = symbolic_loop(
            (left, right, top, active & (top <= bottom), mi.Float(0), mi.Float(0)),
            lambda *state: state[3],
            body,
            "coarse elements",
        )
        return dr.maximum(density, 0) / dr.select(mass > 0, mass, 1)


# ------------------------------------------------------------------------------------------------
#  Building
# ------------------------------------------------------------------------------------------------


def median_square(*components: mi.Float) -> float:
    """The median of the squared lengths of vectors, over at most :data:`MEDIAN_TEXELS` of them."""
    count = dr.width(components[0])
    stride = -(-count // MEDIAN_TEXELS)
    index = mi.UInt32(np.arange(0, count, stride, dtype=np.uint32))
    return float(
        np.median(sum(dr.square(dr.gather(mi.Float, dr.detach(v), index)) for v in components))
    )


def form_of_adjoint(xx: mi.Float, xy: mi.Float, yy: mi.Float, d: mi.Vector2f) -> mi.Float:
    """dᵀ adj(Σ) d, for a symmetric Σ."""
    return dr.fma(dr.fma(yy, d.x, -2 * xy * d.y), d.x, xx * d.y * d.y)


def wrapped(index: mi.Int, count: mi.Int | int, wrap_mode: str) -> tuple[mi.Int, mi.Float]:
    """The stored index for any index along an axis of ``count`` elements, and the factor on the
    element's derivatives along the axis: 1, −1 where it is mirrored, 0 beyond a clamped border."""
    if wrap_mode == "clamp":
        inside = (index >= 0) & (index < count)
        return dr.clip(index, 0, count - 1), dr.select(inside, mi.Float(1), 0)
    period = count if wrap_mode == "repeat" else 2 * count
    index = index - floor_int((mi.Float(index) + 0.5) * dr.rcp(mi.Float(period))) * period
    if wrap_mode == "repeat":
        return index, mi.Float(1)
    beyond = index >= count
    return dr.select(beyond, period - 1 - index, index), dr.select(beyond, mi.Float(-1), 1)


def finest_level(data: mi.TensorXf, wrap_mode: str) -> RawMoments:
    """Level 0: one element per texel, with the moments of the texel mesh under its Gaussian, by
    Gauss and Hermite's rule with three nodes along each axis."""
    height, width, _ = data.shape
    index = dr.arange(mi.Int, width * height)
    pitch, lines = dr.opaque(mi.Int, width), dr.opaque(mi.Int, height)
    row = index // pitch
    column = index - row * pitch
    columns, rows = (
        [wrapped(centre + step, count, wrap_mode)[0] for step in (-1, 0, 1)]
        for centre, count in ((column, pitch), (row, lines))
    )
    normals = [
        [dr.gather(mi.Vector2f, data.array, mi.UInt32(y * pitch + x)) for x in columns]
        for y in rows
    ]
    zero = mi.Float(0)
    n, nx, ny, nn = [zero] * 2, [zero] * 2, [zero] * 2, [zero] * 3
    for j, (below, v) in enumerate(NODES):
        for i, (left, u) in enumerate(NODES):
            corners = [row[left + k] for row in normals[below : below + 2] for k in (0, 1)]
            normal = normal_in_quad(mi.Float(u), mi.Float(v), corners, 0.0)
            weight = WEIGHTS[i] * WEIGHTS[j]
            x, y = (weight * (base - 1 + place) for base, place in ((left, u), (below, v)))
            n = [dr.fma(weight, s, total) for s, total in zip(normal, n, strict=True)]
            nx = [dr.fma(x, s, total) for s, total in zip(normal, nx, strict=True)]
            ny = [dr.fma(y, s, total) for s, total in zip(normal, ny, strict=True)]
            nn = [
                dr.fma(weight * normal[a], normal[b], total)
                for (a, b), total in zip(PAIRS, nn, strict=True)
            ]
    dr.eval(n, nx, ny, nn)
    return RawMoments(n, nx, ny, nn, (width, height), (1.0, 1.0))


def merged(raw: RawMoments, axis: int, wrap_mode: str) -> RawMoments:
    """A level with half as many elements along an axis (0: x, 1: y)."""
    count, spacing = raw.counts[axis], raw.spacing[axis]
    if count == 1:
        return raw
    new_count = ceil(count / 2)
    ratio = count / new_count
    variance = SIGMA_H**2 * (ratio**2 - 1)  # of the Gaussian that merges, in elements
    reach = ceil(MERGE_REACH * sqrt(variance))
    columns, rows = raw.counts
    new_counts = (new_count, rows) if axis == 0 else (columns, new_count)

    index = dr.arange(mi.Int, new_counts[0] * new_counts[1])
    pitch, old_pitch = dr.opaque(mi.Int, new_counts[0]), dr.opaque(mi.Int, columns)
    row = index // pitch
    column = index - row * pitch
    along = column if axis == 0 else row
    # Opaque, so that one kernel serves many levels.
    ratio_, size = dr.opaque(mi.Float, ratio), dr.opaque(mi.Int, count)
    sharpness = dr.opaque(mi.Float, 0.5 / variance)
    step = dr.opaque(mi.Float, spacing)
    centre = dr.fma(mi.Float(along) + 0.5, ratio_, -0.5)
    first = floor_int(centre)
    total = mi.Float(0)
    zero = mi.Float(0)
    n, nx, ny, nn = [zero] * 2, [zero] * 2, [zero] * 2, [zero] * 3
    for k in range(-reach, reach + 2):
        place, sign = wrapped(first + k, size, wrap_mode)
        distance = mi.Float(first + k) - centre
        weight = dr.exp(-sharpness * dr.square(distance))
        source = row * old_pitch + place if axis == 0 else place * old_pitch + column
        means, about_x, about_y, products = (
            [dr.gather(mi.Float, channel, mi.UInt32(source)) for channel in channels]
            for channels in (raw.n, raw.nx, raw.ny, raw.nn)
        )
        turned = about_x if axis == 0 else about_y
        turned[:] = [
            dr.fma(t, sign, distance * step * mean) for t, mean in zip(turned, means, strict=True)
        ]
        n, nx, ny, nn = (
            [dr.fma(weight, value, total) for value, total in zip(values, totals, strict=True)]
            for values, totals in ((means, n), (about_x, nx), (about_y, ny), (products, nn))
        )
        total = total + weight
    scale = dr.rcp(total)
    n, nx, ny, nn = ([value * scale for value in values] for values in (n, nx, ny, nn))
    dr.eval(n, nx, ny, nn)
    new_spacing = spacing * ratio
    spacings = (new_spacing, raw.spacing[1]) if axis == 0 else (raw.spacing[0], new_spacing)
    return RawMoments(n, nx, ny, nn, new_counts, spacings)


def elements_of(raw: RawMoments) -> tuple[mi.Float, mi.Float]:
    """The elements with these moments: :data:`NUMBERS` floats of each, and xy of each.

    The floats are the mean; the Jacobian per cell, first its x column, then its y column; and xx
    and yy of the residual covariance.
    """
    (nx, ny), variance = raw.n, SIGMA_H**2
    jx = [v * (1 / (variance * raw.spacing[0])) for v in raw.nx]
    jy = [v * (1 / (variance * raw.spacing[1])) for v in raw.ny]
    xx, xy, yy = (
        product - raw.n[i] * raw.n[j] - variance * (jx[i] * jx[j] + jy[i] * jy[j])
        for product, (i, j) in zip(raw.nn, PAIRS, strict=True)
    )
    # A difference of numbers up to 1 has the rounding error of these numbers.
    xx, yy = dr.maximum(xx, 0) + ROUNDING, dr.maximum(yy, 0) + ROUNDING
    limit = dr.sqrt((xx - 0.5 * ROUNDING) * (yy - 0.5 * ROUNDING))
    count = raw.counts[0] * raw.counts[1]
    table = dr.zeros(mi.Float, NUMBERS * count)
    index = dr.arange(mi.UInt32, count)
    for k, value in enumerate((nx, ny, jx[0], jx[1], jy[0], jy[1], xx, yy)):
        dr.scatter(table, value, NUMBERS * index + k)
    return table, dr.clip(xy, -limit, limit)
