"""Units of work: how an image is divided.

A unit is some samples in each pixel of a part of the image, drawn from a seed of its own. The plan
of an image follows from the image alone: its pixels, its samples, its seed. Whoever renders a
unit, and in whatever order, the unit's sums are the same to the last bit, see
:mod:`~glintbsdf.scene.passes`, and so is the image, see :mod:`~glintbsdf.scene.merging`. A unit
needs the same memory for any number of samples in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import mitsuba as mi

from glintbsdf.scene.passes import Tile

#: Samples of a unit, at least, where the image has so many.
FEWEST = 1 << 18

#: Samples of a unit, at most: this bounds the memory of a unit that is rendered.
MOST = 1 << 21


@dataclass(frozen=True)
class Unit:
    """Some samples of an image.

    Attributes:
        index (int): its number in the plan, which is the order of merging.
        part (int): the number of its pass: all tiles of a pass make one image of few samples.
        tile (Tile): the pixels that get samples.
        spp (int): samples in each of them.
        seed (int): seed of the sampler.
        stratified (bool): the samples of a pixel must stay together.
        divisible (bool): the integrator can render a part of the tile.
    """

    index: int
    part: int
    tile: Tile
    spp: int
    seed: int
    stratified: bool
    divisible: bool

    def halves(self) -> tuple[Unit, Unit] | None:
        """Two units of half the samples that take the place of this one; None if it has only one.

        They draw other samples, so the image has other noise of the same size.
        """
        seeds = [derived_seed(self.seed, 1 + half) for half in range(2)]
        tile = self.tile
        if self.spp > 1 and not self.stratified:
            parts = [(tile, self.spp // 2), (tile, self.spp - self.spp // 2)]
        elif not self.divisible:
            return None
        elif tile.height > 1:
            top = tile.height // 2
            parts = [
                (replace(tile, height=top), self.spp),
                (replace(tile, y=tile.y + top, height=tile.height - top), self.spp),
            ]
        elif tile.width > 1:
            left = tile.width // 2
            parts = [
                (replace(tile, width=left), self.spp),
                (replace(tile, x=tile.x + left, width=tile.width - left), self.spp),
            ]
        else:
            return None
        first, second = (
            replace(self, tile=tile, spp=spp, seed=seed)
            for (tile, spp), seed in zip(parts, seeds, strict=True)
        )
        return first, second


@dataclass(frozen=True)
class Plan(Sequence[Unit]):
    """All units of an image, in the order in which they are merged: pass by pass, tile by tile.

    Attributes:
        film (Tile): the pixels of the image.
        spp (int): its samples per pixel.
        seed (int): decides the image.
        stratified (bool): whether the sampler wants the samples of a pixel together.
        divisible (bool): whether the integrator can render a part of the pixels.
    """

    film: Tile
    spp: int
    seed: int
    stratified: bool
    divisible: bool = True

    @cached_property
    def parts(self) -> int:
        """Number of passes; their samples differ by one at most."""
        if self.stratified:
            return 1
        return max(1, min(self.spp, self.spp * self.film.pixels // FEWEST))

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """Whole rows of pixels, or parts of a row where even one row has too many samples."""
        film = self.film
        if not self.divisible:
            return (film,)
        most = max(1, MOST // -(-self.spp // self.parts))
        width = film.width if most >= film.width else most
        height = max(1, most // film.width)
        # Tiles of sizes as equal as can be.
        rows, columns = -(-film.height // height), -(-film.width // width)
        return tuple(
            Tile(film.x + x0, film.y + y0, x1 - x0, y1 - y0)
            for y0, y1 in _ranges(film.height, rows)
            for x0, x1 in _ranges(film.width, columns)
        )

    def __len__(self) -> int:
        return self.parts * len(self.tiles)

    @overload
    def __getitem__(self, index: int) -> Unit: ...

    @overload
    def __getitem__(self, index: slice) -> list[Unit]: ...

    def __getitem__(self, index: int | slice) -> Unit | list[Unit]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(index)
        tiles = self.tiles
        part, tile = divmod(index, len(tiles))
        start, end = _range(self.spp, self.parts, part)
        # Seeds of neighbouring images must not share units.
        seed = derived_seed(self.seed, index) if len(self) > 1 else self.seed
        return Unit(index, part, tiles[tile], end - start, seed, self.stratified, self.divisible)


def derived_seed(seed: int, index: int) -> int:
    """The seed of the part numbered ``index`` of what has the seed ``seed``."""
    return int(mi.sample_tea_32(seed, index)[0])


def _range(size: int, count: int, index: int) -> tuple[int, int]:
    """Where one of ``count`` parts of 0…``size`` begins and ends."""
    return size * index // count, size * (index + 1) // count


def _ranges(size: int, count: int) -> list[tuple[int, int]]:
    return [_range(size, count, index) for index in range(count)]
