"""The lattice, against wrapping in NumPy."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.footprint.lattice import BLOCK, Lattice, LatticeAxis

SIZES = (1, 2, 3, 7, 8, 9, 37, 64)
POSITIONS = np.arange(-300, 300)


def wrapped(x, texels, wrap_mode):
    if wrap_mode == "clamp":
        return np.clip(x, 0, texels - 1)
    if wrap_mode == "mirror":
        x = x % (2 * texels)
        return np.minimum(x, 2 * texels - 1 - x)
    return x % texels


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("texels", SIZES)
def test_locate(variant, texels, wrap_mode):
    axis = LatticeAxis(texels, wrap_mode)
    origin, index, end = (
        np.broadcast_to(np.array(v), POSITIONS.shape) for v in axis.locate(mi.Int(POSITIONS))
    )
    assert np.array_equal(origin + index, POSITIONS)
    assert (index >= 0).all() and (index < end).all() and (end <= axis.quads).all()
    for k in range(2):  # both vertices of the quad, along this axis
        shown = axis.source[index + k]
        assert np.array_equal(shown, wrapped(POSITIONS + k, texels, wrap_mode))
    # All of a run is stored from one origin on.
    for position, start, first, last in zip(POSITIONS, origin, index, end, strict=True):
        run = np.arange(first, last)
        expected = wrapped(start + run, texels, wrap_mode)
        assert np.array_equal(axis.source[run], expected), position
    following = np.array(axis.following(mi.Int(POSITIONS), mi.Int(index)))
    assert np.array_equal(axis.source[following], wrapped(POSITIONS + 1, texels, wrap_mode))


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
def test_runs_begin_and_end_with_blocks_outside_of_a_clamped_map(variant, wrap_mode):
    axis = LatticeAxis(37, wrap_mode)
    _, index, end = (np.array(v) for v in axis.locate(mi.Int(POSITIONS)))
    if wrap_mode == "clamp":
        assert axis.quads % BLOCK == 0 and (end % BLOCK == 0).all()
    assert axis.blocks * BLOCK >= axis.quads > (axis.blocks - 1) * BLOCK


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (37, 8), (16, 64)])
def test_corners_show_the_right_texels(variant, shape):
    lattice = Lattice(*shape, "repeat")
    row, column = (i.ravel() for i in np.indices((lattice.y.quads, lattice.x.quads)))
    corners = lattice.corners(mi.Int(row), mi.Int(column))
    for index, (down, right) in zip(corners, ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
        texel = lattice.source[np.array(index)]
        expected = (row + down) % shape[0] * shape[1] + (column + right) % shape[1]
        assert np.array_equal(texel, expected)
