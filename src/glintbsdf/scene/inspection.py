"""Inspection and trimming: the queries that a scene makes to its glint BSDFs, and structures that
are built for these queries only.

A survey renders the scene with few samples, along whole paths, with the scene's own sensor and
integrator. It records the part of each map, and the sizes of footprints, in the queries of each
BSDF. The BSDFs are then built for this domain and a margin (:mod:`~glintbsdf.footprint.domain`).
Within the domain, a trimmed BSDF has the same values as a complete one, to the last bit. Every pass
of the rendering checks that no query was outside. If one was, everything is built in full, and the
pass is rendered again. So the image is the same in any case.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from glintbsdf.footprint.domain import NOTHING, Domain, Gate, Recorder
from glintbsdf.maps.normalmap import MapShape
from glintbsdf.scene import passes, rendering

#: Approximate number of paths that a survey follows.
PATHS = 1 << 18

SEED = 0x5EED

#: Smallest amount of memory that a report mentions, bytes.
NOTABLE = 1e5


@dataclass
class Inspected:
    """A scene and its glint BSDFs, in the order in which ``mi.traverse`` finds them."""

    scene: mi.Scene
    bsdfs: list

    @staticmethod
    def of(scene: mi.Scene) -> Inspected:
        """A scene that was loaded deferred."""
        return Inspected(scene, rendering.glint_bsdfs(scene))


def load(
    filename: str | Path, parameters: Mapping[str, str] | None = None, glint_path: bool = False
) -> Inspected:
    """Load a scene from XML without building its glint BSDFs; see :func:`.load_scene`."""
    return Inspected.of(
        rendering.load_scene(filename, parameters, deferred=True, glint_path=glint_path)
    )


def survey(inspected: Inspected, spp: int | None = None, which: str = "") -> list[Domain | None]:
    """The domain of each BSDF's queries when the scene is rendered.

    The domain is None for a BSDF that no path hits, or that has no map. BSDFs that are not built
    reflect like smooth surfaces during the survey. Their paths can go everywhere that paths of the
    rendering go, but not as often. Mitsuba's ``path`` also evaluates a BSDF at the end of a path,
    without using the value; these queries count as well.

    Args:
        inspected: the scene.
        spp: samples per pixel of the rendering; None for the scene's own number.
        which: the sensor, see :func:`~.chosen_sensor`.

    Raises:
        ValueError: see :func:`~.render`.
    """
    scene = inspected.scene
    sensor = rendering.chosen_sensor(scene, which)
    sampler = sensor.sampler().clone()
    if spp is not None:
        sampler.set_sample_count(spp)
    spp = int(sampler.sample_count())
    film = passes.whole(sensor.film())
    wanted = min(spp, max(1, PATHS // film.pixels))
    few = max(count for count in range(1, wanted + 1) if spp % count == 0)
    shapes = [bsdf.map_shape for bsdf in inspected.bsdfs]
    recorders = [None if shape is None else Recorder(shape) for shape in shapes]
    for bsdf, recorder in zip(inspected.bsdfs, recorders, strict=True):
        bsdf.watch = recorder
    try:
        with (
            rendering.sharing(scene, sensor, spp) as shared,
            rendering.footprints(scene, sensor, spp),
        ):
            passes.sums_of_samples(scene, sensor, scene.integrator(), film, few, spp, SEED, shared)
        return [None if recorder is None else recorder.found() for recorder in recorders]
    finally:
        for bsdf in inspected.bsdfs:
            bsdf.watch = None


def build(inspected: Inspected) -> None:
    """Build all BSDFs in full."""
    for bsdf in inspected.bsdfs:
        bsdf.build()
        bsdf.watch = None


def build_trimmed(inspected: Inspected, domains: list[Domain | None]) -> None:
    """Build all BSDFs for their domains and a margin.

    A BSDF with a map but without a domain is not built. A BSDF without a map is built in full.

    Args:
        inspected: what :func:`load` returns; nothing is built yet.
        domains: what :func:`survey` returns.
    """
    for bsdf, domain in zip(inspected.bsdfs, domains, strict=True):
        if bsdf.map_shape is None:
            bsdf.build()
            continue
        bsdf.watch = Gate(bsdf.map_shape, NOTHING if domain is None else domain.widened())
        if domain is not None:
            bsdf.build(domain.widened())


class Trimmed:
    """Glint BSDFs that are built for the queries of a scene, and in full once a query is outside.

    Its :meth:`missed` is an argument of :class:`~glintbsdf.scene.rendering.Renderer`. Units that
    were rendered before stay valid, as all their queries were within the domain.

    Args:
        inspected: what :func:`load` returns.
        spp: samples per pixel of the rendering; None for the scene's own number.
        which: the sensor, see :func:`~.chosen_sensor`.

    Attributes:
        sufficed (bool): whether all queries so far were within the domain.
    """

    def __init__(self, inspected: Inspected, spp: int | None = None, which: str = "") -> None:
        self.inspected = inspected
        self.sufficed = True
        build_trimmed(inspected, survey(inspected, spp, which))

    def missed(self) -> bool:
        """Whether a query since the last call was outside of the domain. If so, everything is built
        in full."""
        if not self.sufficed or not any(
            bsdf.watch is not None and bsdf.watch.missed() for bsdf in self.inspected.bsdfs
        ):
            return False
        self.sufficed = False
        build(self.inspected)
        return True


# ------------------------------------------------------------------------------------------------
#  Report
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """The report about one glint BSDF of a scene.

    Attributes:
        plugin, name (str): its type and its id.
        shape (MapShape): shape of its map; None without a map.
        domain (Domain): domain of its queries; None if there are none, or without a map.
        complete, trimmed (dict[str, int]): memory of each part when it is built in full, and when
            it is trimmed, bytes. Both are equal if nothing can be trimmed.
        left_out (list[str]): features that its parameters switch off, in words.
        notes (list[str]): decisions about how to read its map, in words.
    """

    plugin: str
    name: str
    shape: MapShape | None
    domain: Domain | None
    complete: dict[str, int]
    trimmed: dict[str, int]
    left_out: list[str]
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        lines = [f'{self.plugin} "{self.name}"' if self.name else self.plugin]
        lines += self.lines("map", self.map_and_queries())
        lines += self.lines("read", self.notes)
        lines += self.lines("built", amounts(self.complete))
        saved = sum(self.complete.values()) - sum(self.trimmed.values())
        if saved >= NOTABLE:
            lines += self.lines("--trim", [*amounts(self.trimmed), f"{saved / 1e6:8.1f} MB  saved"])
        elif self.shape is not None:
            lines += self.lines("--trim", ["saves nothing here"])
        lines += self.lines("left out", self.left_out)
        return "\n".join(lines)

    @staticmethod
    def lines(title: str, entries: list[str]) -> list[str]:
        """Lines of a table: one per entry, the title in front of the first."""
        titles = [title] + [""] * len(entries)
        return [f"  {t:10}{entry}" for t, entry in zip(titles, entries, strict=False)]

    def map_and_queries(self) -> list[str]:
        """Lines about the map, and about the part of it that queries use."""
        if self.shape is None:
            return ["none"]
        width, height = self.shape.width, self.shape.height
        lines = [f"{width} × {height} texels, {self.shape.wrap_mode}"]
        if self.domain is None:
            return [*lines, "no path meets it"]
        share = 1.0
        for (first, last), texels in ((self.domain.columns, width), (self.domain.rows, height)):
            share *= min((last - first + 1) / texels, 1)
        ranges = [
            f"{axis} {(first + 0.5) / texels:.4g} to {(last + 0.5) / texels:.4g}"
            for axis, (first, last), texels in (
                ("u", self.domain.columns, width),
                ("v", self.domain.rows, height),
            )
        ]
        return [
            *lines,
            f"asked for: {', '.join(ranges)}, {100 * share:.3g} % of the map",
            f"footprints: standard deviations of {self.domain.smallest:.3g} to "
            f"{self.domain.largest:.3g} texels",
        ]


def amounts(parts: dict[str, int]) -> list[str]:
    """Lines with the memory of each part, and their sum."""
    notable = {name: size for name, size in parts.items() if size >= NOTABLE}
    if not notable:
        return ["next to nothing"]
    if len(notable) > 1:
        notable["together"] = sum(parts.values())
    return [f"{size / 1e6:8.1f} MB  {name}" for name, size in notable.items()]


def inspect(
    inspected: Inspected,
    spp: int | None = None,
    which: str = "",
    report: Callable[[float], None] = lambda fraction: None,
) -> list[Finding]:
    """Report the queries of each BSDF, its memory, and its memory with ``render --trim``.

    Args:
        inspected: what :func:`load` returns.
        spp: samples per pixel of the rendering, on which footprints depend; None for the scene's
            own number.
        which: the sensor, see :func:`~.chosen_sensor`.
        report: is called with the fraction done.
    """
    domains = survey(inspected, spp, which)
    report(0.1)
    build_trimmed(inspected, domains)
    report(0.3)
    trimmed = [bsdf.parts() for bsdf in inspected.bsdfs]
    build(inspected)
    report(0.7)
    domains = survey(inspected, spp, which)  # once more, with the complete BSDFs
    return [
        Finding(
            bsdf.owner,
            bsdf.name,
            bsdf.map_shape,
            domain,
            bsdf.parts(),
            parts,
            bsdf.left_out(),
            [note.text for note in bsdf.normal_map.notes] if bsdf.normal_map else [],
        )
        for bsdf, domain, parts in zip(inspected.bsdfs, domains, trimmed, strict=True)
    ]
