"""All methods to compare, each with a series of settings. All commands use this list.

A method of the register (:func:`glintbsdf.pndf.methods`) that has no series here has the settings
that it is registered with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, partial

import mitsuba as mi

from benchmarks.cases import STIFF_MAPS, STIFF_SIZE, SYNTHESIS, Case, Surface
from glintbsdf import NormalMap
from glintbsdf.check.truth import mirrors
from glintbsdf.pndf import methods
from glintbsdf.pndf.manifold.mesh import equilateral

#: Elements, lobes and filters all have this roughness σ_r on the disk, so that they can be
#: compared. The α of a filter is √2 times as large.
SIGMA_R = 0.005
ALPHA = SIGMA_R * 2**0.5


@dataclass(frozen=True, eq=False)
class Method:
    """A glint BSDF with one setting.

    ``plugin`` is its dictionary for ``mi.load_dict``, without the map. ``rung`` is the number that
    orders the series of its family, if there is one. ``quick`` says whether the quick report has
    it; ``pndf``, ``image`` and ``cost`` whether these comparisons have it; ``mapped`` whether it
    has a map: only ``cost`` can compare methods without a map.
    """

    family: str
    setting: str
    plugin: dict
    rung: float | None = None
    quick: bool = True
    pndf: bool = True
    image: bool = True
    cost: bool = True
    mapped: bool = True

    @property
    def name(self) -> str:
        return f"{self.family}, {self.setting}"

    @property
    def synthesises(self) -> bool:
        """Whether it needs a sample to synthesise its map from."""
        return self.plugin["type"] == "glint_mip"

    def suits(self, case: Case) -> bool:
        """Whether it can render a map of this case."""
        return self.mapped and (case.sampled or not self.synthesises)

    def describe(self, surface: Surface) -> dict:
        """The dictionary of the BSDF with its map."""
        if not self.synthesises:
            source, options = surface.normal_map, {}
        else:
            source = surface.sample or surface.normal_map
            options = {**SYNTHESIS, "output_size": surface.normal_map.width}
        normals = {"data": mi.TensorXf(source.normals), "wrap_mode": source.wrap_mode}
        return {**self.plugin, **options, **normals}

    def build(self, surface: Surface):
        """Make the P-NDF; no masking is built for it."""
        parameters = {"masking": "none"}
        if self.plugin["type"] == "glint_manifold":
            parameters["epsilon"] = surface.epsilon
        return mi.load_dict({**self.describe(surface), **parameters}).pndf


def ladder(
    family: str,
    parameter: str,
    values: Iterable,
    *,
    label: str | None = None,
    quick: Iterable = (),
    image: Iterable = (),
    cost: Iterable = (),
    **plugin: object,
) -> list[Method]:
    """A method for each value of a parameter; ``quick``, ``image``, ``cost`` are some of these."""
    label = parameter if label is None else label
    return [
        Method(
            family,
            f"{label} {value}".strip(),
            {**plugin, parameter: value},
            rung=None if isinstance(value, str) else float(value),
            quick=value in quick,
            image=value in image,
            cost=value in cost,
        )
        for value in values
    ]


def glitter(setting: str, **parameters: object) -> Method:
    """A setting of ``glint_grid``."""
    plugin = {"type": "glint_grid", **parameters}
    return Method("grid", setting, plugin, quick=setting == "density 8", pndf=False, image=False,
                  mapped=False)  # fmt: skip


manifold = partial(ladder, type="glint_manifold")
elements = partial(ladder, type="glint_elements", sigma_r=SIGMA_R)
mip = partial(ladder, type="glint_mip", sigma_r=SIGMA_R)
filters = partial(ladder, type="glint_filtered", alpha=ALPHA)

EXACT = Method("manifold", "exact", {"type": "glint_manifold"})
THRESHOLDS = (1e-2, 1e-3, 1e-4)
TABLES = (0.2, 0.1, 0.05, 0.02, 0.01)
FILTERS = ("toksvig", "clean", "variance", "lean")

LADDERS = [
    EXACT,
    *manifold("manifold, tables", "max_error", TABLES, quick=(0.2, 0.05), image=(0.05,),
              cost=(0.05,)),
    *manifold("manifold, clusters", "threshold", THRESHOLDS, label="τ", quick=(1e-3,),
              cost=(1e-3,)),
    *elements("elements", "step", (2.0, 1.0, 0.5), quick=(1.0, 0.5), image=(0.5,),
              cost=(1.0, 0.5)),
    *elements("flat elements", "step", (1.0, 0.5), elements="flat"),
    *mip("lobes", "clusters", (16, 32, 64), quick=(16, 32, 64), image=(32,), cost=(32,)),
    *mip("lobes, 32 clusters", "lod_scale", (0.25, 0.5, 1.0), label="C_P"),
    *filters("filter", "method", FILTERS, label="", quick=("toksvig", "lean"), image=FILTERS,
             cost=FILTERS),
    # Its lobe is LEAN's; only the masking differs, which is not part of the P-NDF.
    Method("filter", "leadr", {"type": "glint_filtered", "method": "leadr", "alpha": ALPHA},
           quick=False, pndf=False),
    *(glitter(f"density {d}", density=float(d)) for d in (4, 8, 12)),
    glitter("wheel", colors="wheel"),
    glitter("grooves", detail_alpha_u=0.3),
    glitter("equal sizes", size_variation=0.0),
]  # fmt: skip


REGISTERED = [
    entry
    for entry in methods().values()
    if entry.plugin and entry.plugin not in {method.plugin["type"] for method in LADDERS}
]
METHODS = LADDERS + [
    Method(entry.title, "as registered", {"type": entry.plugin, **entry.settings},
           pndf=entry.takes_map, image=entry.takes_map, mapped=entry.takes_map)
    for entry in REGISTERED
]  # fmt: skip


def brute_force(normal_map: NormalMap, **parameters: object) -> dict:
    """Mirrors that follow the map; sampling alone averages over a pixel."""
    return mirrors(normal_map, **parameters)


def rough(normal_map: NormalMap, to_uv: object = None, **parameters: object) -> dict:
    """Mitsuba's own material with the roughness of the whole map, without glints."""
    alpha_u, alpha_v = normal_map.roughness()
    return {"type": "roughconductor", "alpha_u": alpha_u, "alpha_v": alpha_v, **parameters}


#: Mitsuba's own BSDFs, for comparisons of images; each function makes the dictionary of one.
BASELINES: dict[str, Callable[..., dict]] = {"brute force": brute_force, "roughconductor": rough}

# --------------------------------------------------------------------------------------------------
#  Stiff settings, and the energy that each method promises
# --------------------------------------------------------------------------------------------------

EVERYWHERE, VERTICAL = "everywhere", "vertical"
NO_MAP = ("none",)


@dataclass(frozen=True)
class Stiff:
    """A plugin with parameters, and how to test it.

    ``furnace``: views from which it must not reflect more light than arrives: everywhere, or from
    the vertical. ``sweep``: the stiff parameter and its values. ``lanes``: number of queries for
    NaN, smaller if a query is expensive. ``double``: whether it can compute in float64. ``large``:
    whether to test its density under a footprint of half the map as well.
    """

    plugin: str
    parameters: dict = field(default_factory=dict)
    furnace: str = EVERYWHERE
    sweep: tuple[str, tuple[float, ...]] = ("", ())
    maps: tuple[str, ...] = tuple(STIFF_MAPS)
    lanes: int = 512
    double: bool = True
    large: bool = False


def decades(first: int, last: int) -> tuple[float, ...]:
    """Powers of ten from 10^``first`` to 10^``last``."""
    return tuple(10.0**k for k in range(first, last + 1))


wu = partial(Stiff, "glint_manifold")
yan = partial(Stiff, "glint_elements")
zirr = partial(Stiff, "glint_grid", maps=NO_MAP)
filtered = partial(Stiff, "glint_filtered")
#: Samples for ``glint_mip``, whose map has twice their side; they must be larger than a patch.
SQUARE_MAPS = tuple(STIFF_MAPS)[:6]
SMALL_MIP = {"output_size": 2 * STIFF_SIZE, "patch_size": STIFF_SIZE // 2, "overlap": 4,
             "clusters": 8}  # fmt: skip

STIFF: dict[str, Stiff] = {
    "manifold": wu(sweep=("epsilon", decades(-10, -2))),
    "manifold, disk, beckmann": wu({"kernel": "disk", "masking": "beckmann"}, VERTICAL),
    "manifold, box, analytic": wu({"kernel": "box", "masking": "analytic"}, lanes=64),
    "manifold, no masking": wu({"masking": "none"}, VERTICAL),
    "manifold, threshold": wu({"threshold": 1e-2}, sweep=("threshold", decades(-6, 2))),
    "manifold, max_error": wu({"max_error": 0.1}, sweep=("max_error", decades(-6, 2)), large=True),
    # For large footprints it is LEAN's lobe, with the masking of the map.
    "manifold, hand_over": wu({"hand_over": 0.7}, VERTICAL),
    "elements": yan({}, VERTICAL, ("sigma_r", decades(-8, 0))),
    "elements, flat": yan({"elements": "flat", "step": 2.0}, VERTICAL),
    "elements, flakes": yan({"flake_density": 1e3, "flake_alpha": 0.2}, VERTICAL, maps=NO_MAP),
    "mip": Stiff(
        "glint_mip", SMALL_MIP, VERTICAL, ("sigma_r", decades(-8, 0)), SQUARE_MAPS, large=True
    ),
    "diffuse": Stiff("glint_diffuse", {"reflectance": 1.0}, lanes=64),
    # Mitsuba's frames exist in float32 only.
    "diffuse, Oren–Nayar": Stiff(
        "glint_diffuse", {"reflectance": 1.0, "method": "oren_nayar"}, double=False
    ),
    "grid": zirr(sweep=("density", (-20, -10, -3, 0, 3, 6, 12, 20))),
    "grid, grooves": zirr({"detail_alpha_u": 0.3, "detail_alpha_v": 1e-4}),
    "grid, wheel": zirr({"colors": "wheel", "size_variation": 2.0}),
    "lean": filtered({"method": "lean"}, VERTICAL, ("alpha", decades(-7, 1))),
    "leadr": filtered({"method": "leadr"}),
    "clean": filtered({"method": "clean"}, VERTICAL),
    "toksvig": filtered({"method": "toksvig"}, VERTICAL),
    "toksvig, GGX": filtered({"method": "toksvig", "distribution": "ggx"}, VERTICAL),
    "variance": filtered({"method": "variance"}, VERTICAL),
    "variance, GGX": filtered({"method": "variance", "distribution": "ggx"}, VERTICAL),
} | {
    entry.title: Stiff(entry.plugin, dict(entry.settings), VERTICAL,
                       maps=tuple(STIFF_MAPS) if entry.takes_map else NO_MAP)
    for entry in REGISTERED
}  # fmt: skip

#: Width of the lobe of normals for the value of a parameter; for a degenerate triangle, the radius
#: of its incircle. Narrower lobes than NARROWEST_LOBE are not judged: float32 half vectors are 6e-8
#: apart, and have an error of about 1e-7 if they are computed from two directions.
WIDTHS: dict[str, Callable[[float], float]] = {
    "alpha": lambda alpha: alpha,
    "sigma_r": lambda sigma_r: sigma_r,
    "epsilon": lambda epsilon: equilateral(epsilon)[0][1] / 2,
}
NARROWEST_LOBE = 1e-5


@cache
def stiff_map(name: str) -> NormalMap:
    """A map of :data:`~benchmarks.cases.STIFF_MAPS`, made once."""
    return STIFF_MAPS[name]()
