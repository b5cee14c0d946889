"""Structures for a domain are smaller, and within the domain their values are equal to the last
bit."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.footprint.domain import Domain, Gate, Recorder
from glintbsdf.footprint.lattice import Lattice
from glintbsdf.pndf import (
    ClusteredManifold,
    Elements,
    Filtered,
    HandOver,
    Manifold,
    TabulatedManifold,
)
from glintbsdf.pndf.manifold.diffuse import OrenNayarDiffuse
from glintbsdf.pndf.manifold.projected_area import GgxFit

SIZE = (96, 128)
HEIGHT, WIDTH = SIZE
COUNT = 4096


def normal_map(wrap_mode: str = "repeat") -> NormalMap:
    return NormalMap(maps.isotropic(SIZE, seed=1).normals, wrap_mode)


def footprints(
    centre=(0.4, 0.3), sigma: float = 2.0, spread: float = 0.1, stretch: float = 2.0
) -> Footprint:
    """Random footprints around ``centre`` (UV). Their minor axes have ``sigma`` to 2 ``sigma``
    texels; major axes are up to ``stretch`` times as long."""
    rng = np.random.default_rng(5)
    uv = np.asarray(centre)[:, None] + spread * (rng.random((2, COUNT)) - 0.5)
    angle, minor = rng.uniform(0, np.pi, COUNT), sigma * rng.uniform(1, 2, COUNT)
    major = minor * rng.uniform(1, stretch, COUNT)
    size = np.array([[WIDTH], [HEIGHT]])
    du = major * np.stack([np.cos(angle), np.sin(angle)]) / size
    dv = minor * np.stack([-np.sin(angle), np.cos(angle)]) / size
    return Footprint(
        mi.Point2f(np.float32(uv)), mi.Vector2f(np.float32(du)), mi.Vector2f(np.float32(dv))
    )


def normals() -> mi.Vector2f:
    rng = np.random.default_rng(6)
    return mi.Vector2f(np.float32(0.1 * rng.standard_normal((2, COUNT))))


def recorded(normal_map: NormalMap, footprint: Footprint, active=True) -> Domain | None:
    recorder = Recorder(normal_map)
    recorder(footprint, mi.Bool(active))
    return recorder.found()


def test_recorder_finds_what_footprints_touch(variant):
    domain = recorded(normal_map(), footprints(sigma=2))
    uv, (du, dv) = footprints(sigma=2).uv.numpy(), (footprints(sigma=2).du, footprints(sigma=2).dv)
    size = np.array([[WIDTH], [HEIGHT]])
    extent = 3 * size * np.sqrt(du.numpy() ** 2 + dv.numpy() ** 2)
    first = np.floor((uv * size - 0.5 - extent).min(axis=1))
    last = np.floor((uv * size - 0.5 + extent).max(axis=1)) + 1
    assert domain.columns == (first[0], last[0]) and domain.rows == (first[1], last[1])
    # Random axes come close to both ends; sizes are known to a 16th of an octave.
    assert 2 * 2 ** (-1 / 16) * 0.99 < domain.smallest <= 2.01
    assert 7.7 < domain.largest < 8 * 2 ** (1 / 16)


def test_recorder_heeds_the_active_lanes_only(variant):
    assert recorded(normal_map(), footprints(), active=False) is None
    first = dr.arange(mi.UInt32, COUNT) == 0
    one = recorded(normal_map(), footprints(), active=first)
    everything = recorded(normal_map(), footprints())
    assert one.columns[1] - one.columns[0] < everything.columns[1] - everything.columns[0]


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        (0, 7, {"repeat": (0, 1), "mirror": (0, 1), "clamp": (1, 1)}),
        (17, 40, {"repeat": (2, 4), "mirror": (2, 4), "clamp": (3, 4)}),
        (-1, 5, {"repeat": (15, 2), "mirror": (31, 2), "clamp": (0, 2)}),
        (120, 128, {"repeat": (15, 2), "mirror": (15, 2), "clamp": (16, 2)}),
        (-90, -60, {"repeat": (4, 5), "mirror": (20, 5), "clamp": (0, 1)}),
        (300, 310, {"repeat": (5, 2), "mirror": (5, 2), "clamp": (17, 1)}),
        (-4, 116, {"repeat": (0, 16), "mirror": (31, 16), "clamp": (0, 16)}),
        (-40, 216, {"repeat": (0, 16), "mirror": (0, 32), "clamp": (0, 18)}),
    ],
)
def test_touched_blocks(first, last, expected):
    for wrap_mode, blocks in expected.items():
        axis = Lattice(8, 128, wrap_mode).x
        assert axis.touched_blocks(first, last) == blocks, wrap_mode


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("centre", [(0.4, 0.3), (0.98, 0.5), (-3.0, 0.5), (1.5, 1.6)])
def test_lists_of_a_part_of_the_map(variant, wrap_mode, centre):
    whole_map, footprint, m = normal_map(wrap_mode), footprints(centre), normals()
    complete = Manifold(whole_map)
    expected = complete.eval(m, footprint).numpy()
    for domain in (recorded(whole_map, footprint), recorded(whole_map, footprint).widened()):
        trimmed = Manifold(whole_map, domain=domain)
        assert np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
        assert trimmed.nbytes < complete.nbytes
    # Far outside a clamped map there is a single normal, different from all others.
    assert (expected > 0).any() or wrap_mode == "clamp"


@pytest.mark.parametrize("kernel", ["disk", "box"])
def test_lists_for_other_kernels(variant, kernel):
    footprint, m = footprints(), normals()
    trimmed = Manifold(normal_map(), kernel, domain=recorded(normal_map(), footprint))
    expected = Manifold(normal_map(), kernel).eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)


@pytest.mark.parametrize(
    "create",
    [partial(ClusteredManifold, threshold=1e-2), partial(TabulatedManifold, max_error=0.1)],
    ids=["clusters", "tables"],
)
@pytest.mark.parametrize("sigma", [0.4, 3.0, 12.0])
def test_lists_under_approximations(variant, create, sigma):
    footprint, m = footprints(sigma=sigma, spread=0.01), normals()
    trimmed = create(normal_map(), domain=recorded(normal_map(), footprint))
    complete = create(normal_map())
    expected = complete.eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
    assert trimmed.nbytes < complete.nbytes or sigma == 12.0  # where the whole map is touched


def test_small_footprints_need_no_lists(variant):
    footprint, m = footprints(sigma=0.1), normals()
    trimmed = Manifold(normal_map(), domain=recorded(normal_map(), footprint))
    assert trimmed.parts()["lists of quads"] == 0
    expected = Manifold(normal_map()).eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)


@pytest.mark.parametrize("sigma", [0.1, 0.7, 3.0])
@pytest.mark.parametrize("step", [0.5, 1.6])
def test_elements_under_small_footprints_need_no_lists(variant, step, sigma):
    footprint, m = footprints(sigma=sigma), normals()
    trimmed = Elements(normal_map(), step=step, domain=recorded(normal_map(), footprint))
    complete = Elements(normal_map(), step=step)
    expected = complete.eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
    assert (trimmed.nbytes < complete.nbytes) == (sigma == 0.1)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 6.0])
@pytest.mark.parametrize("method", ["lean", "toksvig", "variance"])
def test_levels_of_a_filter(variant, method, sigma):
    footprint, m = footprints(sigma=sigma), normals()
    trimmed = Filtered(normal_map(), method, domain=recorded(normal_map(), footprint))
    complete = Filtered(normal_map(), method)
    expected = complete.eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
    assert trimmed.nbytes < complete.nbytes


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("centre", [(0.4, 0.3), (0.98, 0.5), (1.5, 1.6)])
def test_parts_of_levels(variant, wrap_mode, centre):
    """Stretched footprints look up samples all along their major axes."""
    whole_map, m = normal_map(wrap_mode), normals()
    footprint = footprints(centre, sigma=0.3, stretch=20)
    trimmed = Filtered(whole_map, "clean", domain=recorded(whole_map, footprint))
    complete = Filtered(whole_map, "clean")
    expected = complete.eval(m, footprint).numpy()
    assert expected.any() and np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
    assert trimmed.nbytes < complete.nbytes


@pytest.mark.parametrize("sigma", [0.1, 1.0, 6.0])
@pytest.mark.parametrize("wrap_mode", ["repeat", "clamp"])
def test_levels_of_masking_and_of_diffuse_reflection(variant, wrap_mode, sigma):
    whole_map, footprint = normal_map(wrap_mode), footprints(sigma=sigma)
    domain = recorded(whole_map, footprint)
    mesh = Manifold(whole_map)
    w = dr.normalize(mi.Vector3f(1, 0.3, 0.2))
    complete, trimmed = GgxFit(mesh), GgxFit(mesh, domain)
    expected = complete.eval(w, footprint).numpy()
    assert np.array_equal(trimmed.eval(w, footprint).numpy(), expected)
    assert sum(trimmed.parts().values()) < sum(complete.parts().values())
    query = (w, w, mi.TransportMode.Radiance, footprint, True)
    expected = OrenNayarDiffuse(mesh).eval(*query).numpy()
    assert np.array_equal(OrenNayarDiffuse(mesh, domain).eval(*query).numpy(), expected)


def test_hand_over_makes_the_levels_it_needs(variant):
    footprint, m = footprints(sigma=3), normals()
    domain = recorded(normal_map(), footprint)
    complete = HandOver(Manifold(normal_map()), 4)
    trimmed = HandOver(Manifold(normal_map(), domain=domain), 4, domain=domain)
    expected = complete.eval(m, footprint).numpy()
    assert np.array_equal(trimmed.eval(m, footprint).numpy(), expected)
    assert trimmed.nbytes < complete.nbytes


def test_gate_keeps_footprints_inside(variant):
    footprint = footprints()
    gate = Gate(normal_map(), recorded(normal_map(), footprint))
    through = gate(footprint, mi.Bool(True))
    assert not gate.missed()
    for name in ("uv", "du", "dv"):
        assert np.array_equal(getattr(through, name).numpy(), getattr(footprint, name).numpy())


@pytest.mark.parametrize(
    "other",
    [{"centre": (0.6, 0.3)}, {"centre": (0.4, 0.1)}, {"sigma": 1.5}, {"sigma": 3}],
    ids=["columns", "rows", "smaller", "larger"],
)
def test_gate_notices_footprints_outside_and_replaces_them(variant, other):
    domain = recorded(normal_map(), footprints())
    gate = Gate(normal_map(), domain)
    through = gate(footprints(**other), mi.Bool(True))
    assert gate.missed()
    found = recorded(normal_map(), through)
    assert domain.columns[0] <= found.columns[0] and found.columns[1] <= domain.columns[1]
    assert domain.rows[0] <= found.rows[0] and found.rows[1] <= domain.rows[1]
    # Sizes are recorded in steps, rounded outwards.
    assert found.smallest >= domain.smallest / 1.05 and found.largest <= domain.largest * 1.05


def test_gate_ignores_inactive_lanes(variant):
    gate = Gate(normal_map(), recorded(normal_map(), footprints()))
    gate(footprints(centre=(0.9, 0.9)), mi.Bool(False))
    assert not gate.missed()


BSDFS = {
    "glint_manifold": {"hand_over": 16.0},
    "glint_filtered": {"method": "leadr"},
    "glint_diffuse": {"method": "oren_nayar"},
}


@pytest.mark.parametrize("plugin", BSDFS)
def test_waiting_to_be_built(variant, plugin):
    data = mi.TensorXf(normal_map().normals)
    parameters = {"type": plugin, "data": data, "pixel_spread": 1e-3, **BSDFS[plugin]}
    bsdf = mi.load_dict(parameters | {"deferred": True})
    ordinary = mi.load_dict(parameters)
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.uv = mi.Point2f(dr.linspace(mi.Float, 0.2, 0.8, 64), 0.3)
    si.t, si.dp_du, si.dp_dv = 1, mi.Vector3f(0.1, 0, 0), mi.Vector3f(0, 0.1, 0)
    si.n = si.sh_frame.n = mi.Normal3f(0, 0, 1)
    si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = dr.normalize(mi.Vector3f(0.2, 0.1, 1))
    wo = dr.normalize(mi.Vector3f(-0.2, 0, 1))

    # The replacement is a smooth surface, without structures of the map.
    smooth, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)
    assert (
        np.ptp(np.array(smooth[0])) == 0 and np.array(smooth[0])[0] > 0 and (pdf > 0).numpy().all()
    )
    sample, weight = bsdf.sample(mi.BSDFContext(), si, 0.3, mi.Point2f(0.4, 0.6))
    assert (sample.pdf > 0).numpy().all() and np.isfinite(np.array(weight[0])).all()
    assert sum(bsdf.parts().values()) < sum(ordinary.parts().values())
    mi.traverse(bsdf).update()
    assert plugin.title().replace("_", "") in str(bsdf)

    bsdf.build()
    assert bsdf.parts() == ordinary.parts()
    values = [np.array(b.eval(mi.BSDFContext(), si, wo)[0]) for b in (bsdf, ordinary)]
    assert np.array_equal(*values) and np.ptp(values[0]) > 0
