"""Synthesised maps: the least cut, the look-up table, seams, repetition, and what is refused."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from glintbsdf import NormalMap, ParameterError, maps
from glintbsdf.maps.quilting import (
    APART,
    BEFORE_X,
    BEFORE_Y,
    lobe_features,
    mesh_lobes,
    minimum_error_cut,
    synthesise,
)

SMOOTH = maps.isotropic(64, seed=1)
SIZES = {"output_size": 256, "patch_size": 16, "overlap": 3}


def noise(size: int = 64) -> NormalMap:
    """Texels without any relation to their neighbours."""
    normals = np.random.default_rng(0).uniform(-0.3, 0.3, (size, size, 2))
    return NormalMap(normals.astype(np.float32))


def differences(normals: np.ndarray, axis: int) -> np.ndarray:
    """Mean of Eq. 7 between each row or column of a map and the one before, the last and first
    among them."""
    features = lobe_features(normals, 0.9)
    squared = ((features - np.roll(features, 1, axis)) ** 2).sum(axis=2)
    return squared.mean(axis=1 - axis)


def seams_and_inside(synthesis) -> tuple[float, float]:
    """Mean difference of neighbours across the cuts, which run through the overlaps, and inside."""
    seams, inside = [], []
    for axis in (0, 1):
        difference = differences(synthesis.explicit(), axis)
        place = synthesis.starts[:-1, None] + np.arange(synthesis.overlap + 1)
        in_overlap = np.zeros(synthesis.size, bool)
        in_overlap[place % synthesis.size] = True
        seams.append(difference[in_overlap].mean())
        inside.append(difference[~in_overlap].mean())
    return float(np.mean(seams)), float(np.mean(inside))


# --------------------------------------------------------------------------------------------------
#  Lobes and cuts
# --------------------------------------------------------------------------------------------------


def test_lobes_of_a_linear_map():
    y, x = np.indices((5, 7))
    mean, jacobian = mesh_lobes(np.stack((0.02 * x - 0.01 * y, 0.03 * y), axis=2))
    expected = np.broadcast_to([[0.02, -0.01], [0, 0.03]], (4, 6, 2, 2))
    assert np.allclose(jacobian[:-1, :-1], expected)
    assert np.allclose(mean[2, 3], [0.02 * 3.5 - 0.01 * 2.5, 0.03 * 2.5])


def test_the_distance_of_lobes_is_that_of_equation_7():
    features = lobe_features(SMOOTH.normals, 0.7)
    mean, jacobian = mesh_lobes(SMOOTH.normals)
    a, b = (3, 5), (40, 17)
    expected = (
        0.7 * ((mean[a] - mean[b]) ** 2).sum() + 0.3 * ((jacobian[a] - jacobian[b]) ** 2).sum()
    )
    assert np.isclose(((features[a] - features[b]) ** 2).sum(), expected, rtol=1e-5)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_no_cut_is_better_than_the_least(width):
    length = 5
    error = np.random.default_rng(1).random((6, length, width))
    paths = [
        path
        for path in product(range(width), repeat=length)
        if all(abs(a - b) <= 1 for a, b in zip(path, path[1:], strict=False))
    ]
    best = [min(e[range(length), p].sum() for p in map(list, paths)) for e in error]
    cut = minimum_error_cut(error)
    assert (np.abs(np.diff(cut, axis=1)) <= 1).all()
    assert np.allclose([e[range(length), p].sum() for e, p in zip(error, cut, strict=True)], best)


# --------------------------------------------------------------------------------------------------
#  The table
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("toroidal", [True, False])
def test_cells_show_their_patches(toroidal):
    synthesis = synthesise(SMOOTH, **SIZES, toroidal=toroidal)
    explicit, starts = synthesis.explicit(), synthesis.starts
    assert explicit.shape == (256, 256, 2)
    inner = int(np.diff(starts).min())
    for y, x in product(range(len(synthesis.patch)), repeat=2):
        row, column = synthesis.origins[synthesis.patch[y, x]]
        inside = slice(synthesis.overlap, inner)
        assert np.array_equal(
            explicit[starts[y] : starts[y + 1], starts[x] : starts[x + 1]][inside, inside],
            SMOOTH.normals[row : row + inner, column : column + inner][inside, inside],
        )


def test_overlaps_show_the_patch_that_owns_them():
    synthesis = synthesise(SMOOTH, **SIZES)
    assert {0, BEFORE_X, BEFORE_Y} <= set(np.unique(synthesis.owners))
    # The first row of the cell (3, 5), beyond the corner: its own patch, or that of the cell above
    row, starts = synthesis.starts[3], synthesis.starts
    for x in range(synthesis.overlap, starts[6] - starts[5]):
        above = synthesis.owners[3, 5, x] == BEFORE_Y
        y = starts[3] - starts[2] if above else 0
        origin = synthesis.origins[synthesis.patch[2 if above else 3, 5]]
        assert np.array_equal(
            synthesis.explicit()[row, starts[5] + x], SMOOTH.normals[origin[0] + y, origin[1] + x]
        )


def test_a_seed_decides_all():
    first, again, other = (synthesise(SMOOTH, **SIZES, seed=seed).explicit() for seed in (4, 4, 5))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("count", [2, 3])
def test_few_cells(count):
    # So few that the cells of a front would touch
    synthesis = synthesise(SMOOTH, output_size=count * 13, patch_size=16, overlap=3)
    assert synthesis.patch.shape == (count, count)
    assert np.isin(synthesis.explicit(), SMOOTH.normals).all()


def test_an_oblong_sample():
    sample = maps.brushed((40, 150), streak_length=20, streak_width=3)
    synthesis = synthesise(sample, output_size=100, patch_size=20)
    assert np.isin(synthesis.explicit(), sample.normals).all()


def test_the_map_is_written_and_read(tmp_path):
    synthesis = synthesise(SMOOTH, output_size=64, patch_size=16)
    synthesis.write(tmp_path / "map.exr")
    # z comes back to the length of one only within rounding
    assert np.allclose(
        NormalMap.load(tmp_path / "map.exr").normals, synthesis.explicit(), atol=1e-7
    )


# --------------------------------------------------------------------------------------------------
#  Seams
# --------------------------------------------------------------------------------------------------


def test_seams_of_a_rough_map_are_no_rougher_than_inside():
    seams, inside = seams_and_inside(synthesise(noise(), **SIZES))
    # Any two patches of it fit alike: measured 1.002, the noise of the comparison
    assert seams <= 1.01 * inside


def test_seams_of_a_smooth_map_are_far_smoother_than_those_of_any_patches():
    chosen, inside = seams_and_inside(synthesise(SMOOTH, **SIZES))
    any_patches, _ = seams_and_inside(synthesise(SMOOTH, **SIZES, tolerance=1e6))
    # Measured: 0.44 and 1.66
    assert chosen <= 0.55 * any_patches
    assert chosen <= 2.5 * inside


def test_more_overlap_makes_smoother_seams():
    ratios = []
    for overlap in (2, 7):
        seams, inside = seams_and_inside(
            synthesise(SMOOTH, output_size=256, patch_size=24, overlap=overlap)
        )
        ratios.append(seams / inside)
    assert ratios[1] < 0.7 * ratios[0]


def test_cells_nearby_show_different_parts_of_the_sample():
    synthesis = synthesise(SMOOTH, **SIZES)
    place = synthesis.origins[synthesis.patch]
    side = int(np.diff(synthesis.starts).max()) + synthesis.overlap
    for shift in product(range(-APART, APART + 1), repeat=2):
        distance = max(map(abs, shift))
        offset = np.abs(place - np.roll(place, shift, (0, 1))).max(axis=2)
        assert distance == 0 or offset.min() >= side / 2**distance


def test_the_default_overlap_is_a_tenth_of_a_patch():
    sizes = {"output_size": 100, "patch_size": 30}
    default, given = synthesise(SMOOTH, **sizes), synthesise(SMOOTH, **sizes, overlap=3)
    assert np.array_equal(default.explicit(), given.explicit())
    assert synthesise(SMOOTH, output_size=20, patch_size=3).overlap == 1


@pytest.mark.parametrize("axis", [0, 1])
def test_a_toroidal_map_fits_to_itself(axis):
    toroidal, open_ended = (synthesise(SMOOTH, **SIZES, toroidal=t) for t in (True, False))
    other_seams = differences(open_ended.explicit(), axis)[open_ended.starts[1:-1]].mean()
    # The cut may run anywhere in the overlap
    edge = differences(toroidal.explicit(), axis)[: SIZES["overlap"] + 1].mean()
    open_edge = differences(open_ended.explicit(), axis)[0]
    assert edge < 2 * other_seams
    assert open_edge > 2 * edge


def test_best_patches_are_taken_where_none_fits_and_counted():
    cells = len(synthesise(SMOOTH, **SIZES).patch) ** 2
    strict, lax = (synthesise(SMOOTH, **SIZES, tolerance=t) for t in (0.0, 1e6))
    # The first fits to anything, and what lies side by side in the sample fits exactly
    assert cells - 10 < strict.best_only < cells
    assert lax.best_only == 0
    assert "the best was taken" in str(strict)
    assert seams_and_inside(strict)[0] < 0.7 * seams_and_inside(lax)[0]


# --------------------------------------------------------------------------------------------------
#  Bad input
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "parameter"),
    [
        ({"patch_size": 64}, "patch_size"),
        ({"patch_size": True}, "patch_size"),
        ({"overlap": 8}, "overlap"),
        ({"output_size": 16}, "output_size"),
        ({"output_size": 19, "overlap": 7}, "overlap"),  # three cells of 6 texels
        ({"balance": -0.1}, "balance"),
        ({"tolerance": float("inf")}, "tolerance"),
        ({"seed": 1.0}, "seed"),
    ],
)
def test_bad_parameters(changes, parameter):
    with pytest.raises(ParameterError, match=rf'synthesise: "{parameter}" must be .* \(got .*\)'):
        synthesise(SMOOTH, **{**SIZES, **changes})
