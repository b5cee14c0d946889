"""What is compared: every method at a ladder of settings, and the maps. One line each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi

from glintbsdf import NormalMap, maps
from glintbsdf.check.truth import mirrors
from glintbsdf.maps.quilting import synthesise

#: Roughness σ_r on the disk that elements, lobes and filters add to the map, so that they answer
#: one question. A filter's α is √2 times that.
SIGMA_R = 0.005
ALPHA = SIGMA_R * 2**0.5


# ------------------------------------------------------------------------------------------------
#  Maps
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Surface:
    """A map, what it was synthesised from if it was, and the clamp of its triangles' Jacobian."""

    name: str
    normal_map: NormalMap
    epsilon: float = 1e-6
    sample: NormalMap | None = None


@dataclass(frozen=True)
class Case:
    """A class of maps: ``sampled`` from a smaller one, or not; ``given`` by a file, or not."""

    name: str
    surface: Callable[[int], Surface]
    sampled: bool = False
    given: bool = False


def procedural(name: str, make: Callable[..., NormalMap], epsilon: float = 1e-6, **options) -> Case:
    """A map of ``glintbsdf.maps``, as large as the report asks for."""
    return Case(name, lambda size: Surface(name, make(size, seed=1, **options), epsilon))


def synthesised(name: str, make: Callable[..., NormalMap], sample_size: int = 256) -> Case:
    """A map of patches of a smaller one, which is all that ``glint_mip`` is given of it."""

    def surface(size: int) -> Surface:
        sample = make(sample_size, seed=1)
        return Surface(name, synthesise(sample, size, **SYNTHESIS).normal_map(), sample=sample)

    return Case(name, surface, sampled=True)


def given(path: Path) -> Case:
    """A map from a file, at its own size."""
    return Case(path.stem, lambda size: Surface(path.stem, NormalMap.load(path)), given=True)


#: Of the synthesised maps.
SYNTHESIS = {"patch_size": 64, "overlap": 2, "balance": 0.9, "seed": 0}

#: Six classes of maps, and synthesised ones. Facets that are quite flat are points on the disk of
#: normals, whose highlight has the area ``epsilon``: of 1e-6 it would be a needle that no grid of
#: points finds.
CASES = [
    procedural("isotropic", maps.isotropic),
    procedural("brushed", maps.brushed),
    procedural("scratched", maps.scratched),
    procedural("flakes", maps.flakes, epsilon=1e-3),
    procedural("leather", maps.leather),
    procedural("smooth", maps.isotropic, correlation_length=48),
    synthesised("isotropic patches", maps.isotropic),
]


# ------------------------------------------------------------------------------------------------
#  Methods
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Method:
    """A glint BSDF at one setting.

    ``plugin`` is its dictionary for ``mi.load_dict``, without the map. ``rung`` is the number that
    the ladder of its family goes by, if it does. ``quick`` says whether the quick report has it;
    ``pndf`` and ``image`` whether it is compared at that level.
    """

    family: str
    setting: str
    plugin: dict
    rung: float | None = None
    quick: bool = True
    pndf: bool = True
    image: bool = True

    @property
    def name(self) -> str:
        return f"{self.family}, {self.setting}"

    @property
    def synthesises(self) -> bool:
        """Whether it needs a sample, rather than a map."""
        return self.plugin["type"] == "glint_mip"

    def suits(self, case: Case) -> bool:
        return case.sampled or not self.synthesises

    def describe(self, surface: Surface) -> dict:
        """The dictionary of the BSDF with its map."""
        if not self.synthesises:
            source, options = surface.normal_map, {}
        else:
            source, options = surface.sample, {**SYNTHESIS, "output_size": surface.normal_map.width}
        normals = {"data": mi.TensorXf(source.normals), "wrap_mode": source.wrap_mode}
        return {**self.plugin, **options, **normals}


def ladder(
    family: str,
    parameter: str,
    values: Iterable,
    *,
    label: str | None = None,
    quick: Iterable = (),
    image: Iterable = (),
    **plugin: object,
) -> list[Method]:
    """One method per value of a parameter; ``quick`` and ``image`` are the values used there."""
    label = parameter if label is None else label
    return [
        Method(
            family,
            f"{label} {value}".strip(),
            {**plugin, parameter: value},
            rung=None if isinstance(value, str) else float(value),
            quick=value in quick,
            image=value in image,
        )
        for value in values
    ]


manifold = partial(ladder, type="glint_manifold")
elements = partial(ladder, type="glint_elements", sigma_r=SIGMA_R)
mip = partial(ladder, type="glint_mip", sigma_r=SIGMA_R)
filters = partial(ladder, type="glint_filtered", alpha=ALPHA)

EXACT = Method("manifold", "exact", {"type": "glint_manifold"})
TABLES = (0.2, 0.1, 0.05, 0.02, 0.01)
FILTERS = ("toksvig", "clean", "variance", "lean")

METHODS = [
    EXACT,
    *manifold("manifold, tables", "max_error", TABLES, quick=(0.2, 0.05), image=(0.05,)),
    *manifold("manifold, clusters", "threshold", (1e-2, 1e-3, 1e-4), label="τ", quick=(1e-3,)),
    *elements("elements", "step", (2.0, 1.0, 0.5), quick=(1.0, 0.5), image=(0.5,)),
    *elements("flat elements", "step", (1.0, 0.5), elements="flat"),
    *mip("lobes", "clusters", (16, 32, 64), quick=(16, 32, 64), image=(32,)),
    *mip("lobes, 32 clusters", "lod_scale", (0.25, 0.5, 1.0), label="C_P"),
    *filters("filter", "method", FILTERS, label="", quick=("toksvig", "lean"), image=FILTERS),
    # Its lobe is LEAN's: only masking and projection differ, which a P-NDF does not have.
    Method("filter", "leadr", {"type": "glint_filtered", "method": "leadr", "alpha": ALPHA},
           quick=False, pndf=False),
]  # fmt: skip


def brute_force(normal_map: NormalMap, **parameters: object) -> dict:
    """Mirrors that follow the map, found by sampling alone."""
    return mirrors(normal_map, **parameters)


def rough(normal_map: NormalMap, to_uv: object, **parameters: object) -> dict:
    """Mitsuba's own material, as rough as the whole map, without any glint."""
    alpha_u, alpha_v = normal_map.roughness()
    return {"type": "roughconductor", "alpha_u": alpha_u, "alpha_v": alpha_v, **parameters}


#: What images are compared with besides: dictionaries of stock BSDFs, by name.
BASELINES: dict[str, Callable[..., dict]] = {"brute force": brute_force, "roughconductor": rough}
