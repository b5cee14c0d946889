"""All methods to compare, each with a series of settings. All commands use this list.

A method of the register (:func:`glintbsdf.pndf.methods`) that has no series here has the settings
that it is registered with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import mitsuba as mi

from benchmarks.cases import SYNTHESIS, Case, Surface
from glintbsdf import NormalMap
from glintbsdf.check.truth import mirrors
from glintbsdf.pndf import methods

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
