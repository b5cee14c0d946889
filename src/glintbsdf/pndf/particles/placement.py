"""Where facets are: lattices of simplices over the surface, and the vertices that a footprint sees.

Positions are counted in spacings of facets, 1/√N of a unit for N facets per unit of area. The
lattice of level j has a vertex in 4^j squared spacings; its cells are triangles, or tetrahedra in
space (Perlin, "Noise Hardware", 2001). A vertex weighs by its barycentric coordinate in the cell
around the point, times a bell around a place near the vertex that is drawn by a hash. The weights
of a cell's vertices are divided by their sum. So they add up to one everywhere, change
continuously, and show no lattice.

A lattice has no origin that matters and no memory. Coordinates are multiplied in double precision
and split at once: integers name the vertices, and only fractions go on in single precision.
"""

from __future__ import annotations

from copy import copy
from math import pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.footprint.kernels import difference_of_products

#: A footprint more elongated than this counts as wider. That limits the cost.
MAX_ANISOTROPY = 16.0

#: Up to this elongation a footprint is one round probe of the same area.
ROUND = 3.0

#: Range of a vertex's random displacement, in cells, and the sharpness of the bell around it.
DISPLACEMENT, SHARPNESS = 0.8, 4.0

#: The mean of Σ b² over places, b the weights of the vertices around, less what facets in strata
#: vary less than facets at random. By dimension; see the tests, which measure the sum of both.
PARTICIPATION = {2: 0.63, 3: 0.54}

#: Coordinates are skewed by this share of their sum, so that simplices become halves of squares and
#: sixths of cubes; and back. By dimension. The skew enlarges areas, which a factor makes up for.
SKEW = {2: (sqrt(3) - 1) / 2, 3: 1 / 3}
UNSKEW = {2: (3 - sqrt(3)) / 6, 3: 1 / 6}
VERTEX_PER_CELL = {2: 3**-0.25, 3: 2 ** (-1 / 3)}

#: Lattices of successive levels are shifted against each other, by irrational fractions of a cell.
SHIFT = (0.7548776662466927, 0.5698402909980532, 0.3287189567246612)

#: Change per cell, along each coordinate, of the threshold at which facets pass over.
RAMP = (0.0217016653792583, 0.0138233511451121, 0.0175736912342311)

#: Steps between the hashed numbers of levels: 2³² over the golden ratio, odd.
LEVEL_STEP = 0x9E3779B9

#: Levels beyond hold more facets in a cell than float32 can tell from infinitely many.
MAX_LEVEL = 60


def power_of_two(exponent: mi.Int) -> mi.Float64:
    """2^exponent, exactly, in double precision; the exponent in [−1022, 1023]."""
    return dr.reinterpret_array(mi.Float64, mi.UInt64(mi.Int64(exponent) + 1023) << 52)


def split(x: mi.Float64) -> tuple[mi.UInt32, mi.Float]:
    """The integer part, modulo 2³², and the fraction of ``x``, |x| < 2⁵¹."""
    floor = dr.floor(x)
    # The last bits of a double near 1.5 · 2⁵² are those of an integer.
    integer = dr.reinterpret_array(mi.UInt64, floor + 1.5 * 2.0**52)
    return mi.UInt32(integer), mi.Float(x - floor)


class Probes:
    """Round probes along the major axis of a footprint, which all weigh alike but for the ends.

    Up to an elongation of :data:`ROUND` there is one, of the footprint's area. A longer footprint
    is covered by more, as many of their areas as make up its own.

    Args:
        first, second: conjugate semi-axes of the footprint, lists of 2 or 3 ``mi.Float``, in units
            of UV or of space: spacings may be so many that their fourth power overflows.
        spacings (mi.Float): of facets in a unit.

    Attributes:
        variance (mi.Float): of one probe along each axis, squared spacings.
        half (mi.Float): half the sum of weights, of which all but the last two are one.
        step (list of mi.Float): from one probe to the next, spacings.
        count (mi.Int): of probes, odd.
    """

    def __init__(self, first: list, second: list, spacings: mi.Float) -> None:
        # The Gram matrix of the axes has the eigenvalues of the covariance.
        a, b, c = (
            sum(x * y for x, y in zip(*pair, strict=True))
            for pair in ((first, first), (first, second), (second, second))
        )
        difference = 0.5 * (a - c)
        root = dr.sqrt(dr.fma(difference, difference, b * b))
        major = 0.5 * (a + c) + root
        crosses = [
            difference_of_products(first[i], second[k], first[k], second[i])
            for i in range(len(first))
            for k in range(i)
        ]
        area = dr.sqrt(sum(dr.square(x) for x in crosses))
        area = dr.maximum(area, major / MAX_ANISOTROPY)
        ratio = dr.select(area > 0, major / dr.select(area > 0, area, 1), 1)
        area = area * dr.square(spacings)
        self.variance = dr.select(ratio > ROUND, ROUND * area / ratio, area)
        self.half = half_number(dr.maximum(ratio / ROUND, 1))
        self.count = 2 * mi.Int(dr.ceil(self.half - 0.5)) + 1
        # The eigenvector (x, y) of the Gram matrix gives the major axis x·first + y·second.
        x, y = dr.select(a >= c, root + difference, b), dr.select(a >= c, b, root - difference)
        unit = dr.rcp(dr.select(major > 0, major, 1))  # squares of small numbers vanish
        x, y = x * unit, y * unit
        axis = [dr.fma(x, p, y * q) for p, q in zip(first, second, strict=True)]
        squared = sum(dr.square(p) for p in axis)
        several = (self.count > 1) & (squared > 0)
        # n even weights, 2√3 σ/n apart, have the variance σ² of the major axis, n/ROUND of it.
        length = dr.sqrt(12 * ROUND * self.variance / dr.select(several, squared, 1))
        self.step = [p * dr.select(several, length, 0) for p in axis]

    def weight(self, probe: mi.Int) -> mi.Float:
        """The share of a probe, counted … −1, 0, 1 …; all add up to one."""
        return dr.clip(self.half + 0.5 - dr.abs(mi.Float(probe)), 0, 1) / (2 * self.half)

    def draw(self, sample: mi.Float) -> tuple[mi.Int, mi.Float]:
        """A probe, drawn by its share from ``sample`` in [0, 1), and what is left of the number."""
        # Probe k has the interval [k − ½, k + ½] within [−half, half].
        last = mi.Float(self.count >> 1)
        place = (2 * sample - 1) * self.half
        probe = dr.clip(dr.round(place), -last, last)
        low, high = dr.maximum(probe - 0.5, -self.half), dr.minimum(probe + 0.5, self.half)
        width = dr.maximum(high - low, 1e-6)
        return mi.Int(probe), dr.clip((place - low) / width, 0, 1 - 2.0**-24)

    def level(self) -> mi.Float:
        """λ: log₂ of the cell, in spacings, of the lattice that shows one probe as many facets as
        there are. In that lattice, a normal cell of 4^λ has one facet in a cell of positions, and
        Σ b² is what N·4πσ² facets of equal weight would have, 4^λ/(N 4πσ²)."""
        dimension = len(self.step)
        # Where the footprint is a point, any level below 0.
        facets = dr.maximum(4 * pi * PARTICIPATION[dimension] * self.variance, 2.0**-8)
        return dr.minimum(0.5 * dr.log2(facets), float(MAX_LEVEL - 1))


def skewed(x: list) -> list:
    """Coordinates in which the vertices of the lattice are those of whole numbers."""
    n = len(x)
    shift = sum(x) * SKEW[n]
    return [(c + shift) * VERTEX_PER_CELL[n] for c in x]


def half_number(n: mi.Float) -> mi.Float:
    """Half the sum of weights 1, …, 1, f at the ends such that n of equal weight would show as many
    facets: for c whole ones, (c + 2f)² = n (c + 2f²)."""
    whole = 2 * dr.floor(0.5 * (n - 1)) + 1
    more = whole * (n - whole)
    root = dr.sqrt(dr.maximum(dr.fma(4 * (4 - 2 * n), more, 16 * whole * whole), 0))
    return 0.5 * whole + 2 * more / (4 * whole + root)


class Lattice:
    """The lattice of one level around a point.

    Args:
        coordinates: of the point, 2 or 3 ``mi.Float64``, :func:`skewed`.
        level (mi.Int): j ≥ 0.
        seed (mi.UInt32): another one gives other facets.

    Attributes:
        origin, fraction: the coordinates in cells of this level, as integers and fractions.
        cell (mi.Float): width of a cell, spacings.
    """

    def __init__(self, coordinates: list, level: mi.Int, seed: mi.UInt32) -> None:
        scale = power_of_two(-level)
        self.per_spacing, self.cell = mi.Float(scale), mi.Float(power_of_two(level))
        self.seed = seed + mi.UInt32(level) * LEVEL_STEP
        shift = mi.Float64(level + 1)
        parts = [
            split(dr.fma(x, scale, shift * s)) for x, s in zip(coordinates, SHIFT, strict=False)
        ]
        self.origin, self.fraction = [p[0] for p in parts], [p[1] for p in parts]

    def where(self, condition: mi.Bool, other: Lattice) -> Lattice:
        """This lattice where the condition holds, the other one elsewhere."""
        result = copy(self)
        for name, mine in vars(self).items():
            theirs = getattr(other, name)
            if isinstance(mine, list):
                chosen = [dr.select(condition, *both) for both in zip(mine, theirs, strict=True)]
            else:
                chosen = dr.select(condition, mine, theirs)
            setattr(result, name, chosen)
        return result

    def phase(self) -> mi.Float:
        """A number that changes steadily over the surface, by :data:`RAMP` per cell; modulo 1."""
        whole = sum(x * round(c * 2**32) for x, c in zip(self.origin, RAMP, strict=False))
        part = sum(x * c for x, c in zip(self.fraction, RAMP, strict=False))
        return dr.fma(mi.Float(whole), 2.0**-32, part)

    def vertices(self, offset: list) -> list[Vertex]:
        """The vertices of the simplex around a point, 3 or 4; their weights add up to one.

        Args:
            offset: of the point from the lattice's, :func:`skewed`, 2 or 3 ``mi.Float``.
        """
        place = [dr.fma(o, self.per_spacing, f) for o, f in zip(offset, self.fraction, strict=True)]
        floor = [dr.floor(x) for x in place]
        place = [x - y for x, y in zip(place, floor, strict=True)]
        origin = [o + mi.UInt32(mi.Int(f)) for o, f in zip(self.origin, floor, strict=True)]
        # The k-th vertex is one step on along the k greatest fractions.
        if len(place) == 2:
            first = place[0] > place[1]
            ranks = [dr.select(first, 0, 1), dr.select(first, 1, 0)]
            ordered = [dr.maximum(*place), dr.minimum(*place)]
        else:
            x, y, z = place
            xy, yz, zx = (mi.UInt32(dr.select(c, 1, 0)) for c in (x >= y, y >= z, z > x))
            ranks = [1 - xy + zx, xy + 1 - yz, yz + 1 - zx]
            low, high = dr.minimum(x, y), dr.maximum(x, y)
            ordered = [dr.maximum(high, z), dr.maximum(low, dr.minimum(high, z))]
            ordered.append(dr.minimum(low, z))
        bounds = [mi.Float(1), *ordered, mi.Float(0)]
        found = [
            Vertex(self, origin, place, [mi.UInt32(dr.select(r < k, 1, 0)) for r in ranks],
                   bounds[k] - bounds[k + 1])
            for k in range(len(place) + 1)
        ]  # fmt: skip
        total = dr.rcp(sum(vertex.weight for vertex in found))
        for vertex in found:
            vertex.weight = vertex.weight * total
        return found


class Vertex:
    """One of the vertices of the simplex around a point.

    Args:
        lattice (Lattice): the lattice.
        origin, place: the point, in cells, as whole numbers and fractions.
        step: from the whole numbers to the vertex, 0 or 1 along each coordinate.
        barycentric (mi.Float): coordinate of the point.

    Attributes:
        weight (mi.Float): b.
        seed (mi.UInt32): of the facets at this vertex.
        distance (list of mi.Float): from the point to the facets, spacings.
    """

    def __init__(
        self, lattice: Lattice, origin: list, place: list, step: list, barycentric: mi.Float
    ) -> None:
        n = len(origin)
        index = [o + s for o, s in zip(origin, step, strict=True)]
        random = pcg3d(index[0], index[1], lattice.seed)
        if n == 3:
            random = pcg3d(random[0], random[1], index[2] + random[2])
        self.seed = random[2]
        d = [mi.Float(s) - p for s, p in zip(step, place, strict=True)]
        shift = sum(d) * UNSKEW[n]
        # The third displacement is made of bits that the others leave.
        bits = [random[0], random[1], (random[0] << 23) ^ (random[1] << 14)]
        d = [
            dr.fma(DISPLACEMENT, uniform(r), (x - shift) * (1 / VERTEX_PER_CELL[n]))
            - 0.5 * DISPLACEMENT
            for x, r in zip(d, bits, strict=False)
        ]
        squared = sum(dr.square(x) for x in d)
        self.weight = barycentric * dr.square(dr.rcp(dr.fma(SHARPNESS, squared, 1)))
        self.distance = [x * lattice.cell for x in d]


def fade(level: mi.Float) -> tuple[mi.Int, mi.Float]:
    """The finer of the two levels that λ lies between, and the share of facets of the coarser one.

    Of K lattice points of normals, 4^j at level j, one facet each is seen: with the share T of the
    coarser level the variance of D is (1 − T) 4^−j + T 4^−(j+1), which is 4^−λ where
    T = 4/3 (1 − 4^(j − λ)).
    """
    j = dr.maximum(mi.Int(dr.floor(level)), 0)
    share = (1 - dr.exp2(2 * (mi.Float(j) - level))) * (4 / 3)
    return j, dr.clip(share, 0, 1)
