"""Lattices of facets: weights, levels, probes, hashes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check.suite import random_numbers
from glintbsdf.pndf.particles.placement import (
    PARTICIPATION,
    Lattice,
    Probes,
    fade,
    skewed,
    split,
)

COUNT = 1 << 17


def lattice(dimension: int, extent: float = 1000.0, level: int = 0) -> Lattice:
    places = random_numbers(COUNT, dimension, 3)
    coordinates = skewed([mi.Float64(x) * extent for x in places])
    return Lattice(coordinates, mi.Int(level), mi.UInt32(7))


def zero(dimension: int) -> list:
    return [mi.Float(0)] * dimension


@pytest.mark.parametrize("dimension", [2, 3])
def test_weights_are_a_partition(variant, dimension):
    weights = np.array([v.weight for v in lattice(dimension).vertices(zero(dimension))])
    assert (weights >= 0).all() and np.allclose(weights.sum(axis=0), 1, atol=1e-6)
    # Facets in strata vary by a tenth less than facets at random (see test_particles.py).
    assert np.isclose((weights**2).sum(axis=0).mean() * 0.905, PARTICIPATION[dimension], rtol=0.01)


@pytest.mark.parametrize("dimension", [2, 3])
def test_weights_are_continuous(variant, dimension):
    """Along a line, the total weight of each vertex changes by no more than its slope allows."""
    steps = np.linspace(0, 20, 20_001, dtype=np.float32)
    direction = np.array([0.8, 0.47, 0.37])[:dimension]
    offset = skewed([mi.Float(steps) * float(d) for d in direction])
    place = Lattice(skewed([mi.Float64(0.3)] * dimension), mi.Int(0), mi.UInt32(7))
    vertices = place.vertices(offset)
    seeds = np.array([v.seed for v in vertices])
    weights = np.array([v.weight for v in vertices])
    jump = 0.0
    for seed in np.unique(seeds):
        weight = np.where(seeds == seed, weights, 0).sum(axis=0)
        jump = max(jump, np.abs(np.diff(weight)).max())
    assert jump < 0.01, jump  # measured: 0.003 in steps of 0.001 cells


@pytest.mark.parametrize("dimension", [2, 3])
def test_facets_lie_about_the_place(variant, dimension):
    """The facets that a place sees have their mean there, on average, and a cell's spread."""
    vertices = lattice(dimension).vertices(zero(dimension))
    for k in range(dimension):
        mean, square = (
            sum(v.weight * v.distance[k] ** power for v in vertices) for power in (1, 2)
        )
        assert abs(float(dr.mean(mean)[0])) < 0.01
        assert 0.1 < float(dr.mean(square)[0]) < 0.16


def test_one_vertex_per_spacing(variant):
    """A square of 100 × 100 spacings holds 10⁴ vertices."""
    seeds = set()
    for vertex in lattice(2, extent=100.0).vertices(zero(2)):
        seeds |= set(np.array(vertex.seed).tolist())
    assert abs(len(seeds) / 1e4 - 1) < 0.05  # and those around its border


def test_integers_and_fractions_are_exact_far_away(variant):
    x = np.array([-3.25, -1.0, 0.0, 7.5, 2.0**32 + 0.25, -(2.0**40) - 0.5, 1e12 + 0.125])
    whole, fraction = split(mi.Float64(x))
    assert (np.array(whole) == np.floor(x).astype(np.int64) % 2**32).all()
    assert (np.array(fraction) == x - np.floor(x)).all()


def test_far_places_have_facets_as_near_ones_do(variant):
    """At |uv| = 10⁶ and 10¹² facets per unit, places half a facet apart still differ."""
    scale = 1e6
    uv = mi.Float64(999_999.0) + mi.Float64(random_numbers(COUNT, 1, 5)[0])
    here = Lattice(skewed([uv * scale, uv * scale]), mi.Int(0), mi.UInt32(1))
    there = Lattice(skewed([uv * scale + 0.5, uv * scale]), mi.Int(0), mi.UInt32(1))
    moved = np.array(there.vertices(zero(2))[0].weight) - np.array(here.vertices(zero(2))[0].weight)
    assert np.abs(moved).mean() > 0.1
    fraction = np.array(here.fraction[0])
    assert abs(fraction.mean() - 0.5) < 0.01 and abs(fraction.var() - 1 / 12) < 0.002


def test_share_of_the_coarser_level(variant):
    """The variance of D between two levels is 4^−λ, and levels hand over without a jump."""
    level = np.linspace(0, 6, 601, dtype=np.float32)
    fine, share = (np.array(x, np.float64) for x in fade(mi.Float(level)))
    variance = (1 - share) * 4.0**-fine + share * 4.0 ** -(fine + 1)
    assert np.allclose(variance, 4.0 ** -level.astype(np.float64), rtol=1e-4)
    below = [np.array(x) for x in fade(mi.Float([-5.0, -0.1]))]
    assert (below[0] == 0).all() and (below[1] == 0).all()


@pytest.mark.parametrize("ratio", [1.0, 2.9, 3.1, 6.0, 16.0])
def test_probes_have_the_footprints_area_and_variance(variant, ratio):
    c, s = np.cos(0.7), np.sin(0.7)
    probes = Probes(
        [mi.Float(ratio * c), mi.Float(ratio * s)], [mi.Float(-s), mi.Float(c)], mi.Float(1)
    )
    count = int(probes.count[0])
    order = np.arange(count) - count // 2
    weights = np.array([probes.weight(mi.Int(int(k)))[0] for k in order])
    assert np.isclose(weights.sum(), 1, atol=1e-6)
    effective = 1 / (weights**2).sum()
    # As many facets as there are under the footprint
    assert np.isclose(effective * float(probes.variance[0]), ratio, rtol=1e-4)
    step = np.hypot(*(float(x[0]) for x in probes.step))
    along = (weights * (order * step) ** 2).sum() + float(probes.variance[0])
    if ratio > 4:
        assert np.isclose(along, ratio**2, rtol=0.35)
        direction = np.array([float(x[0]) for x in probes.step]) / step
        assert np.isclose(abs(direction @ [c, s]), 1, atol=1e-5)


def test_probes_are_drawn_by_their_shares(variant):
    c = mi.Float(9.0)
    probes = Probes([c, mi.Float(0)], [mi.Float(0), mi.Float(1)], mi.Float(1))
    probe, left = probes.draw((dr.arange(mi.Float, COUNT) + 0.5) / COUNT)
    probe, left = np.array(probe), np.array(left)
    for k in np.unique(probe):
        drawn = probe == k
        share = float(probes.weight(mi.Int(int(k)))[0])
        assert np.isclose(drawn.mean(), share, atol=1e-4)
        assert abs(left[drawn].mean() - 0.5) < 1e-3 and left[drawn].max() < 1
