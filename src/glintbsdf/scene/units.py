"""Units of work: the division of an image.

A unit has a few samples in each pixel of a part of the image, and its own seed. The plan of an
image depends only on the image: on its pixels, its samples and its seed. The sums of a unit are the
same to the last bit on every machine and in every order (:mod:`~glintbsdf.scene.passes`), and so is
the image (:mod:`~glintbsdf.scene.merging`). The memory that a unit needs does not depend on the
number of samples of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import mitsuba as mi

from glintbsdf.scene.passes import Tile

#: Smallest number of samples of a unit, if the image has as many. Smaller images have up to PASSES
#: units with fewer samples, so that Ctrl-C can keep some of them, and the noise is known.
FEWEST = 1 << 18
PASSES = 8

#: Largest number of samples of a unit. It bounds the memory for rendering a unit.
MOST = 1 << 21


@dataclass(frozen=True)
class Unit:
    """Some samples of an image.

    Attributes:
        index (int): its number in the plan, by which units are merged.
        part (int): number of its pass. All tiles of a pass together are the whole image with a few
            samples.
        tile (Tile): the pixels that get samples.
        spp (int): samples in each of these pixels.
        seed (int): seed of the sampler.
        stratified (bool): whether the samples of a pixel must stay together.
        divisible (bool): whether the integrator can render a part of the tile.
    """

    index: int
    part: int
    tile: Tile
    spp: int
    seed: int
    stratified: bool
    divisible: bool

    def halves(self) -> tuple[Unit, Unit] | None:
        """Two units with half of the samples that replace this one; None if it cannot be divided.

        They draw different samples. So the noise of the image is different, but of the same size.
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
        spp (int): samples per pixel of the image.
        seed (int): seed of the image.
        stratified (bool): whether the samples of a pixel must stay together.
        divisible (bool): whether the integrator can render a part of the pixels.
    """

    film: Tile
    spp: int
    seed: int
    stratified: bool
    divisible: bool = True

    @cached_property
    def parts(self) -> int:
        """Number of passes; their numbers of samples differ by at most one."""
        if self.stratified:
            return 1
        samples = self.spp * self.film.pixels
        small = min(PASSES, 2 * PASSES * samples // FEWEST)
        return max(1, min(self.spp, max(small, samples // FEWEST)))

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """Tiles of whole rows of pixels, or parts of a row if one row has too many samples."""
        film = self.film
        if not self.divisible:
            return (film,)
        most = max(1, MOST // -(-self.spp // self.parts))
        width = film.width if most >= film.width else most
        height = max(1, most // film.width)
        # All tiles have about the same size.
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
        # Units of images with successive seeds must not have the same seed.
        seed = derived_seed(self.seed, index) if len(self) > 1 else self.seed
        return Unit(index, part, tiles[tile], end - start, seed, self.stratified, self.divisible)


def derived_seed(seed: int, index: int) -> int:
    """The seed of part number ``index`` of an image or unit with the seed ``seed``."""
    return int(mi.sample_tea_32(seed, index)[0])


def _range(size: int, count: int, index: int) -> tuple[int, int]:
    """Begin and end of one of ``count`` parts of 0…``size``."""
    return size * index // count, size * (index + 1) // count


def _ranges(size: int, count: int) -> list[tuple[int, int]]:
    return [_range(size, count, index) for index in range(count)]
