"""The plan of an image: complete, disjoint, of bounded units, and the same in every process."""

from __future__ import annotations

import numpy as np
import pytest

from glintbsdf.scene import units
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.units import Plan

PLANS = [
    Plan(Tile(0, 0, 16, 16), 16, 0, stratified=False),
    Plan(Tile(0, 0, 1024, 1024), 8192, 1, stratified=False),
    Plan(Tile(0, 0, 3840, 2160), 3, 2, stratified=False),
    Plan(Tile(7, 9, 640, 480), 8191, 3, stratified=False),  # a prime number
    Plan(Tile(0, 0, 300, 200), 1024, 4, stratified=True),
    Plan(Tile(0, 0, 5_000_000, 1), 2, 5, stratified=False),
    Plan(Tile(0, 0, 4, 4), 1 << 20, 6, stratified=True),
]


@pytest.mark.parametrize("plan", PLANS, ids=str)
def test_units_are_small_and_make_the_whole(variant, plan):
    tiles = plan.tiles
    assert sum(tile.pixels for tile in tiles) == plan.film.pixels
    if plan.film.pixels < 1 << 21:
        covered = np.zeros((plan.film.height, plan.film.width), int)
        for tile in tiles:
            covered[tile.slices(plan.film)] += 1
        assert (covered == 1).all()
    first = [plan[index] for index in range(0, len(plan), len(tiles))]
    assert sum(unit.spp for unit in first) == plan.spp
    assert max(unit.spp for unit in first) - min(unit.spp for unit in first) <= 1
    samples = [unit.spp * unit.tile.pixels for unit in (plan[0], plan[len(plan) - 1])]
    assert max(samples) <= max(units.MOST, plan.spp if plan.stratified else 1)
    if plan.spp * plan.film.pixels >= units.FEWEST and len(tiles) == 1:
        assert min(samples) >= units.FEWEST


@pytest.mark.parametrize("spp, pixels, count", [
    (16, 100, 1),  # a small image is rendered at once
    (16, 1 << 18, 16),  # at most one pass per sample
    (64, 1 << 14, 8),
    (12, 1 << 17, 8),
    (13, 1 << 16, 8),
    (64, 1 << 10, 4),
    (96, 1 << 17, 48),
    (1, 1 << 24, 1),
])  # fmt: skip
def test_number_of_passes(spp, pixels, count):
    assert Plan(Tile(0, 0, pixels, 1), spp, 0, stratified=False).parts == count


def test_samples_of_a_stratified_sampler_stay_together():
    plan = Plan(Tile(0, 0, 300, 200), 1024, 0, stratified=True)
    assert plan.parts == 1 and len(plan.tiles) > 1
    assert all(unit.spp == 1024 for unit in plan)


def test_units_draw_from_seeds_of_their_own(variant):
    seeds = {unit.seed for seed in range(3) for unit in Plan(Tile(0, 0, 512, 512), 64, seed, False)}
    assert len(seeds) == 3 * 64


def test_a_plan_ends():
    plan = Plan(Tile(0, 0, 16, 16), 1, 0, stratified=False)
    assert len(list(plan)) == len(plan) == 1
    with pytest.raises(IndexError):
        plan[1]


@pytest.mark.parametrize("stratified", [False, True])
def test_halves_are_the_unit(variant, stratified):
    """No pixel is lost, down to one sample, or to the samples of one pixel."""
    unit = Plan(Tile(2, 3, 5, 4), 6, 0, stratified)[0]
    parts, single = [unit], []
    while parts:
        part = parts.pop()
        halves = part.halves()
        if halves is None:
            single.append(part)
        else:
            assert len({part.seed, *(half.seed for half in halves)}) == 3
            parts += halves
    samples = np.zeros((4, 5), int)
    for part in single:
        assert part.tile.pixels == 1 and part.spp == (6 if stratified else 1)
        samples[part.tile.slices(unit.tile)] += part.spp
    assert (samples == 6).all()
