"""Merging: the image does not depend on the order of units; the contents of a checkpoint."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest

from glintbsdf.scene import merging, storage, units
from glintbsdf.scene.image import Image
from glintbsdf.scene.merging import merge
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.storage import Checkpoint, Refused
from glintbsdf.scene.units import Plan

FILM = Tile(2, 1, 12, 8)
SIGMA = 0.5


@pytest.fixture
def plan(variant, monkeypatch) -> Plan:
    """A plan with 40 passes of two tiles each: 80 units."""
    monkeypatch.setattr(units, "FEWEST", 4 * 96)
    monkeypatch.setattr(units, "MOST", 4 * 48)
    plan = Plan(FILM, 160, 0, stratified=False)
    assert plan.parts == 40 and len(plan.tiles) == 2
    return plan


def sums_of(unit) -> np.ndarray:
    """Colours of mean 1 and a known deviation, and weights; they depend on the unit only."""
    random = np.random.default_rng(unit.seed)
    shape = (unit.tile.height, unit.tile.width, 3)
    colours = 1 + random.normal(scale=SIGMA, size=(unit.spp, *shape)).astype(np.float32)
    weights = np.full((*shape[:2], 1), unit.spp, np.float32)
    return np.concatenate([colours.sum(axis=0, dtype=np.float32), weights], axis=-1)


class Workers:
    """Renders units in batches, each in another order, and counts them."""

    def __init__(self, batch: int = 1, order: int = 0, die_after: int | None = None) -> None:
        self.batch, self.die_after = batch, die_after
        self.random = np.random.default_rng(order)
        self.rendered: list[int] = []

    def __call__(self, wanted):
        wanted = iter(wanted)
        while batch := list(itertools.islice(wanted, self.batch)):
            for number in self.random.permutation(len(batch)):
                if self.die_after is not None and len(self.rendered) == self.die_after:
                    raise ConnectionError("the scheduler is gone")
                unit = batch[number]
                self.rendered.append(unit.index)
                yield unit, unit.tile, sums_of(unit)
                yield None


def image_of(plan, workers=None, **options) -> Image:
    image = Image(plan, base_channels=4)
    merge(image, workers or Workers(), **options)
    return image


def checkpoint(folder: Path, **description) -> Checkpoint:
    return Checkpoint(folder, {"scene": "abc", "version": "1", **description})


# ---------------------------------------------------------------------------------------------
#  Order
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch, order", [(2, 1), (7, 2), (80, 3)])
@pytest.mark.parametrize("memory", [merging.WAITING, 0], ids=["memory", "disk"])
def test_the_order_of_units_changes_no_bit(plan, batch, order, memory, monkeypatch):
    expected = image_of(plan)
    assert expected.count == len(plan) and expected.fraction == 1 and expected.spp == 160
    monkeypatch.setattr(merging, "WAITING", memory)
    image = image_of(plan, Workers(batch, order))
    assert np.array_equal(image.sums, expected.sums) and np.array_equal(image.odd, expected.odd)
    assert (image.sums[..., 3] == 160).all()
    assert (image.odd[..., 3] == 80).all()


def test_noise_is_the_standard_error(plan):
    image = image_of(plan)
    # Of 96 pixels, three colours: a relative deviation of 1/√(2 · 288) = 4 %.
    assert image.noise == pytest.approx(SIGMA / 160**0.5, rel=0.15)
    colours = image.sums[..., :3] / image.sums[..., 3:]
    assert colours.mean() == pytest.approx(1, abs=4 * SIGMA / (160 * 288) ** 0.5)


def test_few_passes_tell_no_noise(plan):
    image = Image(plan, base_channels=4)
    for index in range(7):
        assert image.noise is None
        image.add(plan[index].tile, sums_of(plan[index]))
    image.add(plan[7].tile, sums_of(plan[7]))
    assert image.noise is not None


def test_a_black_image_has_no_relative_noise(plan):
    image = Image(plan, base_channels=4)
    for unit in plan:
        image.add(unit.tile, sums_of(unit) * [0, 0, 0, 1])
    assert image.noise is None


# ---------------------------------------------------------------------------------------------
#  Interruption
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [1, 9, 80])
def test_until_noise_ends_at_the_same_pass(plan, batch):
    """It does not depend on the units that are rendered by then."""
    wanted = SIGMA / 60**0.5
    image = image_of(plan, Workers(batch, batch), until_noise=wanted)
    assert image.noise <= wanted and image.count % 2 == 0
    assert np.array_equal(image.sums, image_of(plan, until_noise=wanted).sums)
    assert 40 <= image.spp <= 80


def test_time_limit(plan):
    clock = iter(np.arange(0.0, 1000.0, 1.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merging.time, "monotonic", lambda: next(clock))
        image = image_of(plan, time_limit=20.0)
    assert 5 <= image.count <= 20


def test_observer_sees_every_unit(plan):
    seen = []
    image_of(plan, observe=lambda image: seen.append(image.count))
    assert seen == list(range(1, 81))


# ---------------------------------------------------------------------------------------------
#  Checkpoints
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("die_after", [0, 1, 15, 16, 17, 50, 79])
def test_a_rendering_goes_on_where_it_ended(plan, tmp_path, die_after):
    folder = tmp_path / "kept"
    with pytest.raises(ConnectionError):
        image_of(plan, Workers(5, 1, die_after), checkpoint=checkpoint(folder))
    workers = Workers(3, 2)
    image = image_of(plan, workers, checkpoint=checkpoint(folder))
    assert np.array_equal(image.sums, image_of(plan).sums)
    assert len(workers.rendered) == 80 - die_after
    again = Workers()
    assert np.array_equal(image_of(plan, again, checkpoint=checkpoint(folder)).sums, image.sums)
    assert again.rendered == []


def test_a_checkpoint_stays_small(plan, tmp_path):
    image_of(plan, Workers(5), checkpoint=checkpoint(tmp_path))
    assert len(list(tmp_path.glob("sums-*"))) == 2
    assert len(list(tmp_path.glob("unit-*"))) <= 2 * storage.UNITS_PER_SNAPSHOT
    assert not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "exchanged"])
def test_damaged_files_are_made_again(plan, tmp_path, damage):
    with pytest.raises(ConnectionError):
        image_of(plan, Workers(1, 0, 60), checkpoint=checkpoint(tmp_path))
    for pattern in ("unit-*", "sums-*"):
        victim = sorted(tmp_path.glob(pattern))[-1]
        content = bytearray(victim.read_bytes())
        if damage == "cut":
            content = content[:-9]
        elif damage == "flip":
            content[len(content) // 2] ^= 1
        elif damage == "empty":
            content = b""
        elif pattern == "unit-*":  # another unit's, whole
            content = sorted(tmp_path.glob(pattern))[-2].read_bytes()
        victim.write_bytes(content)
    workers = Workers()
    image = image_of(plan, workers, checkpoint=checkpoint(tmp_path))
    assert np.array_equal(image.sums, image_of(plan).sums)
    assert 59 in workers.rendered and len(workers.rendered) == 21


def test_all_sums_damaged(plan, tmp_path):
    with pytest.raises(ConnectionError):
        image_of(plan, Workers(1, 0, 60), checkpoint=checkpoint(tmp_path))
    for path in tmp_path.glob("sums-*"):
        path.write_bytes(b"nonsense")
    assert np.array_equal(image_of(plan, checkpoint=checkpoint(tmp_path)).sums, image_of(plan).sums)


def test_a_checkpoint_of_another_rendering_is_refused(plan, tmp_path):
    image_of(plan, Workers(), checkpoint=checkpoint(tmp_path, seed=3))
    with pytest.raises(Refused, match=r"belongs to another rendering: its seed is 3, .* is 4\."):
        checkpoint(tmp_path, seed=4)
    with pytest.raises(Refused, match="its version is 1, this one's is 2"):
        checkpoint(tmp_path, seed=3, version="2")
    (tmp_path / "rendering.json").write_text("{")
    with pytest.raises(Refused, match="is damaged"):
        checkpoint(tmp_path, seed=3)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("dear")
    with pytest.raises(Refused, match="is not empty and no checkpoint"):
        checkpoint(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_full_disk_ends_it_and_what_is_done_stays(plan, tmp_path, monkeypatch):
    replace, count = storage.os.replace, itertools.count()

    def full(source, target):
        if next(count) >= 30:
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(storage.os, "replace", full)
    with pytest.raises(OSError, match="cannot write .*No space left on device"):
        image_of(plan, checkpoint=checkpoint(tmp_path))
    monkeypatch.undo()
    monkeypatch.setattr(units, "FEWEST", 4 * 96)
    monkeypatch.setattr(units, "MOST", 4 * 48)
    assert not list(tmp_path.glob("*.tmp"))
    workers = Workers()
    image = image_of(plan, workers, checkpoint=checkpoint(tmp_path))
    assert np.array_equal(image.sums, image_of(plan).sums) and len(workers.rendered) < 60


def test_a_checkpoint_may_be_moved(plan, tmp_path):
    with pytest.raises(ConnectionError):
        image_of(plan, Workers(1, 0, 20), checkpoint=checkpoint(tmp_path / "a"))
    shutil.move(tmp_path / "a", tmp_path / "b")
    workers = Workers()
    image_of(plan, workers, checkpoint=checkpoint(tmp_path / "b"))
    assert len(workers.rendered) == 60
