"""Adaptive quadrature of densities: narrow spikes, and densities that differ from the samples."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import maps
from glintbsdf.check import densities, suite


def test_quadrature_finds_spikes_of_any_size(variant):
    # Half of the mass in three disks of radius 1e-4, half over the square: the disks are as narrow
    # and as far apart as the highlights of flat triangles.
    rng = np.random.default_rng(1)
    centres, radius = np.array([[0.3, -0.2], [0.31, -0.2], [-0.7, 0.9]]), 1e-4

    def density(s):
        distance = np.linalg.norm(s[:, None] - centres, axis=2)
        return 0.5 / 4 + 0.5 / 3 * (distance < radius).sum(1) / (np.pi * radius**2)

    def draw(count):
        r, angle = radius * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
        spikes = centres[rng.integers(0, 3, count)]
        spikes = spikes + np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
        return np.where(rng.random((count, 1)) < 0.5, spikes, rng.uniform(-1, 1, (count, 2)))

    training, test = draw(8000), draw(8000)
    cells, cell_of = densities.partition(training)
    assert np.isclose(np.prod(cells[:, 1] - cells[:, 0], axis=1).sum(), 4)
    assert (densities.count_in(cells, training) == np.bincount(cell_of, minlength=len(cells))).all()
    mass, error = densities.mass_of(density, cells, training, cell_of)
    total = np.sqrt((error**2).sum())
    assert total < 4e-3 and abs(mass.sum() - 1) < 4 * total
    counts = densities.count_in(cells, test)
    assert suite.p_value(counts, len(test), mass, error) > 1e-3
    # The test detects a sampler that draws spikes that are one percent too wide.
    wider = test.copy()
    for centre in centres:
        near = np.linalg.norm(wider - centre, axis=1) < 2 * radius
        wider[near] = centre + 1.2 * (wider[near] - centre)
    assert suite.p_value(densities.count_in(cells, wider), len(test), mass, error) < 1e-5


def test_quadrature_finds_narrow_spikes_by_few_samples(variant, monkeypatch):
    # Like 16 degenerate triangles: each has a thousandth of the mass, in a quarter of the square.
    rng = np.random.default_rng(2)
    centres, radius = rng.uniform(0.1, 0.9, (16, 2)), 1e-5

    def density(s):
        near = (np.linalg.norm(s[:, None] - centres, axis=2) < radius).sum(1)
        return 0.984 / 2 * (s[:, 0] < 0) + 0.001 * near / (np.pi * radius**2)

    points = rng.uniform((-1, -1), (0, 1), (20_000, 2))
    r, angle = radius * np.sqrt(rng.random(320)), rng.uniform(0, 2 * np.pi, 320)
    offset = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
    points[:320] = centres[rng.integers(0, 16, 320)] + offset
    monkeypatch.setattr(densities, "MOST_BOXES", 4)  # subdivide only where there are samples
    cells = np.array([[[-1, -1], [0, 1]], [[0, -1], [1, 1]]], float)
    mass, error = densities.mass_of(density, cells, points, (points[:, 0] >= 0).astype(int))
    # Where no sample leads the subdivision, both mass and error are 0.
    assert error[1] < 0.02 and (np.abs(mass - [0.984, 0.016]) < 4 * error + 1e-4).all()


def test_view_that_sees_no_facet(variant):
    data = mi.TensorXf(maps.tilted(32, 0.5, 0.3).normals)
    bsdf = mi.load_dict({"type": "glint_manifold", "footprint_sigma": 1.0, "data": data})
    view = suite.View(wi=(-1, 0.4, 0.05))
    assert (np.array(suite.sample(bsdf, view, 100)[1].pdf) == 0).all()
    found = densities.density(bsdf, view, 100)
    assert found == {"mass": 0.0, "mass_error": 0.0, "p_value": 1.0}
    # The test detects density without samples.
    stated = densities.density(Stated(bsdf, lambda *x: mi.Float(0.1)), view, 100)
    assert stated["mass"] > 0.05


class Stated:
    """A BSDF whose pdf differs from the density of its samples."""

    def __init__(self, bsdf, pdf):
        self.bsdf, self.pdf = bsdf, pdf

    def __getattr__(self, name):
        return getattr(self.bsdf, name)


def test_cells_around_points_that_coincide(variant):
    # Like a lobe that is hardly wider than the spacing of float32.
    points = np.full((300, 2), 0.6)
    points[200:] += np.linspace(0, 1e-4, 100)[:, None]
    cells, cell_of = densities.partition(points)
    assert np.isclose(np.prod(cells[:, 1] - cells[:, 0], axis=1).sum(), 4)
    assert len(np.unique(cell_of)) > 3


def test_false_densities_are_found(variant):
    def rough(alpha):
        return mi.load_dict({"type": "roughconductor", "alpha": alpha, "distribution": "beckmann"})

    bsdf, view = rough(0.2), suite.View(wi=(0.3, 0.1, 1))
    true = densities.density(bsdf, view, 8192)
    assert abs(true["mass"]) < 4 * true["mass_error"] + 1e-3 and true["p_value"] > 1e-3
    bright = densities.density(Stated(bsdf, lambda *x: 1.05 * bsdf.pdf(*x)), view, 8192)
    assert bright["mass"] == pytest.approx(true["mass"] + 0.05, abs=5e-3)
    wide = densities.density(Stated(bsdf, rough(0.22).pdf), view, 8192)
    assert abs(wide["mass"]) < 4 * wide["mass_error"] + 5e-3 and wide["p_value"] < 1e-5
