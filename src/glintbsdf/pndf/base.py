"""The interface of P-NDFs, their contract, and the register of all of them.

A P-NDF D(m) is the distribution of the normals under a footprint, a density over the disk of
projected normals: ``∫ D(m) dm = 1``. One object has the density, its sampler, and the projected
area of its facets, from which masking follows.

A new method is a class that derives from :class:`PNDF`, implements the abstract methods, and
enters the register::

    @register("my_method", title="My method")
    class MyMethod(PNDF):
        ...

Tests, benchmarks and the report take their methods from the register. The page "Write your own
P-NDF" shows how to write one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.alignment import aligned
from glintbsdf.core.cache import load_or_build
from glintbsdf.core.memory import check_room
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.microfacet.frame import normal_from_projection
from glintbsdf.microfacet.masking import BeckmannMasking, GGXMasking, MeanPlaneMasking, SmithMasking


class Colors(Protocol):
    """Colours of facets. The contract requires only their mean, linear RGB."""

    mean: tuple[float, ...]


class PNDF(ABC):
    """The distribution of the normals under a footprint.

    It belongs to the variant of Mitsuba that is active when it is made.

    A subclass implements :meth:`_eval` and :meth:`_sample`, and overrides methods that differ from
    the defaults here. Callers use :meth:`eval`, :meth:`sample` and the methods after them.

    Attributes:
        owner (str): name in error messages, usually the plugin's.
        normal_map (NormalMap): the map; None for a P-NDF without one.
        domain (Domain): the queries that the structure is built for; None for any query.
        intensity (mi.Float): factor on the reflection; None for 1.
        colors (Colors): colours of the facets; D is then an ``mi.Color3f``. None for a P-NDF
            without colours.
    """

    #: Kernel of the footprint and clamp of triangles that a reference must use to agree.
    kernel: str = "gaussian"
    epsilon: float = 0.0

    #: The maskings that :meth:`masking` can make, the default one first.
    maskings: ClassVar[tuple[str, ...]] = ("beckmann", "none")

    #: Whether D uses the ``spread`` and the ``turn`` of a query: the P-NDF then integrates lights
    #: of some extent.
    integrates_lights: ClassVar[bool] = False

    #: Whether samples of D alone look for an environment, where lights are integrated: a value of D
    #: then costs more than a sample of the environment tells.
    finds_environment: ClassVar[bool] = False

    #: Parameters on which the roughness of the whole surface depends.
    roughness_keys: ClassVar[tuple[str, ...]] = ("data", "sigma_r")

    #: Memory that building takes at most, bytes per texel of a map that repeats, besides the map
    #: (``python -m benchmarks front``). 0 for a P-NDF that takes little.
    bytes_per_texel: ClassVar[float] = 0.0

    owner: str = "PNDF"
    normal_map: NormalMap | None = None
    data: mi.TensorXf
    domain: Domain | None = None
    intensity: mi.Float | None = None
    colors: Colors | None = None

    # ----------------------------------------------------------------------------------------------
    #  The structure
    # ----------------------------------------------------------------------------------------------

    def build(self, domain: Domain | None = None) -> None:
        """Build the structures for queries within ``domain``, or for any; they replace former ones.

        Within the domain, results equal those of a complete structure to the last bit. A method
        may build for a larger domain, never for a smaller one. By default there is no structure.
        """
        self.domain = domain

    @classmethod
    def check_room(cls, normal_map: NormalMap, owner: str, domain: Domain | None) -> None:
        """Raise :class:`~.ParameterError` where the structures of a map take more memory than is
        free. A domain makes them smaller than can be told beforehand."""
        if domain is None:
            periods = 4 if normal_map.wrap_mode == "mirror" else 1
            shape = normal_map.height, normal_map.width
            check_room(owner, normal_map.parameter, shape, periods * cls.bytes_per_texel)

    def cached(self, build: Callable[[], Mapping[str, np.ndarray]], *parameters: object) -> dict:
        """Arrays from the cache on disk, or from ``build()``; see :func:`~.load_or_build`.

        The key is the map and ``parameters``, besides the source of the builder. Nothing is kept
        for a map that has been changed since it was loaded.
        """
        if self.changed:
            return dict(build())
        content = () if self.normal_map is None else (self.normal_map.content_hash,)
        return load_or_build(build, *content, *parameters)

    def prepare_for_lights(self) -> None:
        """Build the structures for queries with a spread, unless they exist. Nothing can be built
        while a kernel is recorded, so this has to be called before such queries."""

    #: Whether parameters have been changed since the construction.
    changed: bool = False

    def parts(self) -> dict[str, int]:
        """Memory of each part of what has been built, bytes."""
        return {}

    @property
    def nbytes(self) -> int:
        """Memory of all parts, bytes."""
        return sum(self.parts().values())

    def left_out(self) -> list[str]:
        """Features that the parameters switch off, and why, in words."""
        return []

    # ----------------------------------------------------------------------------------------------
    #  The distribution
    # ----------------------------------------------------------------------------------------------

    def eval(
        self, m: mi.Vector2f, query: Query | Footprint, active: bool | mi.Bool = True
    ) -> mi.Float | mi.Color3f:
        """D(m), the density of projected normals over the unit disk; 0 outside of it.

        ``m``: projected normals, any number of them. ``query``: a query, or just a footprint in the
        UV space of the map.
        """
        return self._eval(m, Query.of(query), mi.Bool(active))

    def eval_normal(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> mi.Float | mi.Color3f:
        """D of the unit normal ``m``."""
        return self.eval(mi.Vector2f(m.x, m.y), query, active)

    def sample(
        self,
        query: Query | Footprint,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: bool | mi.Bool = True,
    ) -> mi.Vector2f:
        """Draw a projected normal with the density D, from random numbers in [0, 1).

        One that falls outside the disk is an invalid sample, as D is 0 there.
        """
        return self._sample(Query.of(query), sample1, sample2, mi.Bool(active))

    @abstractmethod
    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float | mi.Color3f:
        """Implementation of :meth:`eval`."""

    @abstractmethod
    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Implementation of :meth:`sample`."""

    def sample_visible(
        self,
        wi: mi.Vector3f,
        query: Query,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> mi.Vector3f:
        """A unit normal for the view from ``wi``; one with z ≤ 0 is an invalid sample.

        By default the normal is drawn from D, whatever the view.
        """
        return normal_from_projection(self.sample(query, sample1, sample2, active))

    def visible_pdf(
        self,
        wi: mi.Vector3f,
        m: mi.Vector3f,
        density: mi.Float,
        query: Query,
        active: mi.Bool,
    ) -> mi.Float:
        """Density of :meth:`sample_visible` at the unit normal ``m``, per solid angle.

        ``density``: D(m), which the caller has evaluated.
        """
        return density * m.z

    def normal_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """A rectangle (lower, upper) of projected normals outside of which D is 0, float64 (2,).

        By default the whole disk.
        """
        return np.full(2, -1.0), np.full(2, 1.0)

    def relative_error(self, query: Query | Footprint) -> mi.Float:
        """A bound on the relative L1 error of D that the method itself predicts; 0 if exact."""
        return mi.Float(0)

    # ----------------------------------------------------------------------------------------------
    #  Roughness and masking
    # ----------------------------------------------------------------------------------------------

    def alpha_squared(self) -> mi.Vector2f:
        """Squared Beckmann roughness along u and v of all normals together, without the intrinsic
        roughness of each: by default, twice the mean squared slope of the map."""
        return map_alpha_squared(self.data)

    def smooth(self) -> PNDF | None:
        """The smooth P-NDF of very large footprints; None if D is smooth itself."""
        return None

    def masking(self, name: str, height_correlated: bool = True) -> SmithMasking | None:
        """Masking and shadowing by one of :attr:`maskings`; None for ``none``.

        ``footprint`` is the masking of the facets under the footprint over their mean plane, by
        :meth:`projected_areas`; ``beckmann`` and ``ggx`` are those of a surface of this
        distribution, as rough as all normals together.
        """
        if name == "footprint":
            return MeanPlaneMasking(self, height_correlated)
        if name == "beckmann":
            return BeckmannMasking(self.alpha_squared, height_correlated, self.roughness_keys)
        if name == "ggx":
            return GGXMasking(self.alpha_squared, height_correlated, self.roughness_keys)
        if name == "none":
            return None
        raise NotImplementedError(f"{type(self).__name__} has no masking {name}")

    def projected_areas(
        self, directions: list[mi.Vector3f], query: Query, active: mi.Bool
    ) -> tuple[list[mi.Float], mi.Vector2f]:
        """``(areas, mean slope)``: P(ω) = ∫ D(m) max(m·ω, 0) dω_m for unit vectors of the upper
        hemisphere, and the mean slope m_xy/m_z of the facets under the footprint."""
        raise NotImplementedError(f"{type(self).__name__} knows no projected areas")

    # ----------------------------------------------------------------------------------------------
    #  Parameters
    # ----------------------------------------------------------------------------------------------

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show the parameters to ``callback``."""

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check the parameters ``keys``, or all if empty, and rebuild structures that depend on
        them."""


def changed_map(data: mi.TensorXf, wrap_mode: str, owner: str) -> NormalMap:
    """The map of projected normals (H×W×2) that a user has set.

    Values that come from NumPy move to memory that begins at a cache line, see :func:`~.stored`.
    Values with derivatives are computed, and are in such memory.

    Raises:
        ParameterError: the values are no map.
    """
    values = aligned(data.numpy().copy())  # what numpy() returns goes with the former values
    if not dr.grad_enabled(data):
        mi.set_property(data, type(data)(values))  # in place, as the scene's parameters refer to it
    return NormalMap(values, wrap_mode, owner, "data")


def map_alpha_squared(data: mi.TensorXf) -> mi.Vector2f:
    """Squared Beckmann roughness of a map of projected normals (H×W×2) along u and v."""
    s = dr.unravel(mi.Vector2f, data.array)
    z_squared = 1 - dr.squared_norm(s)
    return mi.Vector2f([2 * dr.mean(x * x / z_squared) for x in s])


# --------------------------------------------------------------------------------------------------
#  The register
# --------------------------------------------------------------------------------------------------

P = TypeVar("P", bound=type[PNDF])


@dataclass(frozen=True)
class Method:
    """A P-NDF in the register.

    Attributes:
        name (str): its name, lower case.
        title (str): its name in reports.
        pndf (type): the class.
        takes_map (bool): whether the class takes a :class:`~glintbsdf.NormalMap` first.
        plugin (str): type of the plugin that wraps it.
        options (dict): arguments, besides the map, with which tests and reports make it.
        settings (dict): the same options, as parameters of the plugin.
    """

    name: str
    title: str
    pndf: type[PNDF]
    takes_map: bool
    plugin: str
    options: Mapping[str, object] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)

    def create(self, normal_map: NormalMap | None = None, **options: object) -> PNDF:
        """Make the P-NDF, with ``normal_map`` if it takes one; ``options`` override its own."""
        arguments = (normal_map,) if self.takes_map else ()
        return self.pndf(*arguments, **{**self.options, **options})  # type: ignore[call-arg]


_methods: dict[str, Method] = {}


def register(
    name: str,
    title: str,
    plugin: str = "",
    takes_map: bool = True,
    options: Mapping[str, object] | None = None,
    settings: Mapping[str, object] | None = None,
) -> Callable[[P], P]:
    """Enter a class in the register, see :class:`Method`; a decorator.

    Raises:
        TypeError: the class lacks a part of the contract, which the message names; or another class
            has the name.
    """

    def enter(pndf: P) -> P:
        if not (isinstance(pndf, type) and issubclass(pndf, PNDF)):
            raise TypeError(f'P-NDF "{name}": must derive from glintbsdf.pndf.base.PNDF')
        missing = sorted(getattr(pndf, "__abstractmethods__", ()))
        if missing:
            raise TypeError(
                f'P-NDF "{name}": must implement {", ".join(missing)} (got {pndf.__qualname__} '
                "without)"
            )
        known = _methods.get(name)
        home = (pndf.__module__, pndf.__qualname__)
        if known is not None and (known.pndf.__module__, known.pndf.__qualname__) != home:
            raise TypeError(
                f'P-NDF "{name}": must have a name of its own '
                f"(got that of {known.pndf.__module__}.{known.pndf.__qualname__})"
            )
        _methods[name] = Method(
            name, title, pndf, takes_map, plugin, dict(options or {}), dict(settings or {})
        )
        return pndf

    return enter


def methods() -> dict[str, Method]:
    """All methods in the register, by name, in the order in which they were entered."""
    import glintbsdf.pndf  # noqa: F401 (whose methods enter themselves)

    return dict(_methods)
