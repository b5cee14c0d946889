"""The scenes that come with the package load, glint, and need nothing from outside."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.examples import EXAMPLES
from glintbsdf.scene.rendering import glint_bsdfs, load_scene


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_renders(name, tmp_path, variant, capfd):
    files = EXAMPLES[name].copy(tmp_path / "new" / name)
    assert {path.name for path in (tmp_path / "new" / name).iterdir()} == {p.name for p in files}
    small = {"resx": "24", "resy": "18", "spp": "4"}
    scene = load_scene(files[0], small)
    assert glint_bsdfs(scene)
    image = np.array(mi.render(scene))
    assert image.shape[:2] == (18, 24) and np.isfinite(image).all()
    # The lamps' glints are much brighter than the room and the softbox. Measured: 8 to 30; four
    # samples have wide footprints.
    assert image.max() > 6 * np.median(image) > 0
    assert not re.search("warn", capfd.readouterr().out, re.IGNORECASE)


def test_the_files_are_the_same_each_time(tmp_path, variant):
    for name, example in EXAMPLES.items():
        first, second = (example.copy(tmp_path / folder / name) for folder in "ab")
        for one, other in zip(first, second, strict=True):
            assert one.read_bytes() == other.read_bytes()


def test_nothing_is_overwritten(tmp_path, variant):
    (tmp_path / "kept").write_text("mine")
    with pytest.raises(FileExistsError, match="choose another"):
        EXAMPLES["glitter"].copy(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


def test_a_failure_leaves_no_folder(tmp_path, variant, monkeypatch):
    def fail(path) -> None:
        raise OSError("no space left")

    monkeypatch.setitem(EXAMPLES["vase"].made, "vase.obj", fail)
    with pytest.raises(OSError, match="no space"):
        EXAMPLES["vase"].copy(tmp_path / "vase")
    assert not list(tmp_path.iterdir())
