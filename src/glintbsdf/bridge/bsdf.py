"""The base classes: BSDFs that see a footprint, and glint BSDFs, microfacet BRDFs around a P-NDF.

``mi.BSDF`` is another class in every variant of Mitsuba, so this module is imported anew for each
(see ``registration.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple
from weakref import WeakSet

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.bridge.carried import FINDS_ENVIRONMENT, HAS_FOOTPRINT, INTEGRATES_LIGHTS, Carried
from glintbsdf.bridge.parameters import EXTINCTION, Parameters, check_to_uv, declared_range
from glintbsdf.bridge.separation import asks_for_smooth_lobes
from glintbsdf.bridge.spectra import ColorConversion
from glintbsdf.bridge.surfaces import doubt_of_green, require_uvs, shapes_of
from glintbsdf.core.errors import ParameterError, check
from glintbsdf.core.messages import warn
from glintbsdf.footprint.domain import Domain, Gate, Recorder
from glintbsdf.footprint.gaussian import Footprint, is_literal_zero
from glintbsdf.footprint.query import Place, Query
from glintbsdf.maps.normalmap import MapShape, NormalMap
from glintbsdf.microfacet.frame import normal_from_projection
from glintbsdf.microfacet.interface import Component, Mirror
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.microfacet.slope_frame import SlopeFrame
from glintbsdf.pndf.base import PNDF
from glintbsdf.pndf.displaced import Displaced, DisplacedMasking
from glintbsdf.pndf.sharing import in_turn
from glintbsdf.pndf.smooth import MIN_ALPHA, SmoothBeckmann

_alive: WeakSet[FootprintBSDF] = WeakSet()


def prepare_for_lights() -> None:
    """Make all that BSDFs need to integrate lights, before a kernel is recorded that asks them.

    An integrator may ask while it suspends derivatives, and use what is made when it does not.
    """
    with dr.resume_grad():
        for bsdf in list(_alive):
            pndf = getattr(bsdf, "pndf", None)
            if pndf is not None and bsdf.integrates_lights:
                pndf.prepare_for_lights()


class MakesOpaque:
    """A callback of ``traverse`` that takes the values of parameters out of the code of kernels, so
    that another value needs no other kernel. Zeros stay: what they switch off is left out."""

    def put(self, name: str, value: object, flags: int) -> None:
        """Called for every parameter, as ``mi.TraversalCallback.put`` is."""
        if isinstance(value, mi.Float) and not is_literal_zero(value):
            dr.make_opaque(value)


class RefusesDerivatives:
    """A callback of ``traverse`` that raises :class:`~.ParameterError` if derivatives are enabled
    for a parameter that has none, as they would silently be zero."""

    def __init__(self, owner: str) -> None:
        self.owner = owner

    def put(self, name: str, value: object, flags: int) -> None:
        """Called for every parameter, as ``mi.TraversalCallback.put`` is."""
        if int(flags) & int(mi.ParamFlags.NonDifferentiable) and dr.is_array_v(value):
            if dr.grad_enabled(value):
                raise ParameterError(
                    f'{self.owner}: "{name}" has no derivative (asked for by dr.enable_grad)'
                )


class ChecksSpectra:
    """A callback of ``traverse`` that raises :class:`~.ParameterError` where a spectrum that was
    given as numbers has left its range. ``keys``: the parameters to look at; empty for all."""

    def __init__(self, owner: str, keys: Sequence[str]) -> None:
        self.owner, self.keys = owner, keys

    def put(self, name: str, value: object, flags: int) -> None:
        """Called for every parameter, as ``mi.TraversalCallback.put`` is."""
        if not isinstance(value, mi.Texture) or (self.keys and name not in self.keys):
            return
        numbers = mi.traverse(value)
        if "value" not in numbers:
            return
        values = np.array(numbers["value"]).ravel()
        largest = EXTINCTION.maximum if name in ("eta", "k") else 1.0
        allowed = (values >= 0) & (values <= largest)
        requirement = f"a spectrum of values from 0 to {largest:g}"
        check(allowed.all(), self.owner, name, requirement, values.tolist())


class FootprintBSDF(mi.BSDF):
    """A BSDF that depends on the footprint: its parameters, and what follows from them.

    A subclass's constructor reads its parameters, then calls :meth:`build` unless it is
    ``deferred``: the loader of the scene then calls it, with the domain that the scene needs.

    Attributes:
        owner, name (str): type and id of the plugin, for errors and warnings.
        deferred (bool): whether the constructor is to build nothing. The property of this name is
            set by :func:`glintbsdf.scene.rendering.load_scene`, not by users.
        to_uv (mi.ScalarAffineTransform3f): transform of UV space.
        footprint_sigma, pixel_spread (mi.Float): see :meth:`Footprint.from_interaction`.
        normal_map (NormalMap): the map as it was loaded, None without one.
        green_is_given (bool): whether ``flip_y`` was given.
        watch (Recorder | Gate): gets every footprint; None by default.

    Raises :class:`~.ParameterError` for values that are not allowed.
    """

    #: Whether it averages over what an interaction carries, see :class:`~.Carried`.
    integrates_lights = False

    #: Parameters of the P-NDF that a texture gives at every surface point.
    textures: Mapping[str, mi.Texture] = {}

    normal_map: NormalMap | None = None
    watch: Recorder | Gate | None = None

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        _alive.add(self)
        self.owner, self.name = props.plugin_name(), props.id()
        self.deferred = props.get("deferred", False)
        self.green_is_given = "flip_y" in props
        parameters = Parameters(props)
        parameters.refuse_unknown()
        self.to_uv = parameters.to_uv()
        self.footprint_sigma = mi.Float(parameters.number("footprint_sigma", 0.5))
        self.pixel_spread = mi.Float(parameters.number("pixel_spread", 0.0))
        self.warned_of_point_footprint = self.looked_at_surfaces = False

    @property
    def map_shape(self) -> MapShape | None:
        """Size and wrap mode of the map that footprints are on; None without a map."""
        return None if self.normal_map is None else self.normal_map.shape

    def build(self, domain: Domain | None = None) -> None:
        """Build structures for queries within ``domain``, or for any; they replace former ones."""
        raise NotImplementedError

    def parts(self) -> dict[str, int]:
        """Memory of each part of what has been built, bytes."""
        return {}

    def left_out(self) -> list[str]:
        """Features that the parameters switch off, and why, in words."""
        return []

    def remedies(self) -> list[str]:
        """Parameters that would make evaluation faster, and how, in words."""
        return []

    def traverse(self, callback: mi.TraversalCallback) -> None:
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, texture in self.textures.items():
            callback.put(name, texture, flags)
        callback.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)
        callback.put("footprint_sigma", self.footprint_sigma, flags)
        callback.put("pixel_spread", self.pixel_spread, flags)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        self.traverse(MakesOpaque())
        self.traverse(ChecksSpectra(self.owner, keys))
        if not keys or "to_uv" in keys:
            check_to_uv(self.owner, self.to_uv)
        for key in {"footprint_sigma", "pixel_spread"} & set(keys):
            value = getattr(self, key)
            allowed = declared_range(self.owner, key)
            check(
                dr.all((value >= allowed.minimum) & (value <= allowed.maximum)),
                self.owner,
                key,
                str(allowed),
                value,
            )

    # A value and its density share one query, in ``eval_pdf``. Dr.Jit removes results that a caller
    # does not use from the kernel.
    def eval(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: bool | mi.Bool = True,
    ) -> mi.Spectrum:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: bool | mi.Bool = True,
    ) -> mi.Float:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def footprint(self, si: mi.SurfaceInteraction3f, active: bool | mi.Bool = True) -> Footprint:
        """The footprint at ``si`` in the UV space of the map, for a query of the active lanes."""
        self.look_at_surfaces()
        footprint = Footprint.from_interaction(si, self.footprint_sigma, self.pixel_spread)
        if footprint.is_known_to_be_zero() and not is_literal_zero(self.footprint_sigma):
            self.warn_of_point_footprint()
        identity = self.to_uv == type(self.to_uv)()  # Mitsuba's != is never true of transforms
        if not identity:
            footprint = footprint.transformed(self.to_uv)
        return footprint if self.watch is None else self.watch(footprint, mi.Bool(active))

    def look_at_surfaces(self) -> None:
        """Check, once, whether the shapes with this BSDF fit its map.

        Raises:
            ParameterError: a shape lacks what :meth:`require_of_surfaces` asks for.
        """
        if self.looked_at_surfaces:
            return
        self.looked_at_surfaces = True
        self.require_of_surfaces()
        if self.normal_map is None or self.green_is_given:
            return
        if doubt := doubt_of_green(self.normal_map, self.to_uv, shapes_of(self)):
            warn(f'{self.owner} "{self.name}": {doubt}')

    def require_of_surfaces(self) -> None:
        """Refuse shapes on which this BSDF cannot be, by default meshes without UV coordinates."""
        require_uvs(self.owner, shapes_of(self))

    def place(self, si: mi.SurfaceInteraction3f) -> Place | None:
        """Where ``si`` is in space, for a P-NDF that is placed there; by default None."""
        return None

    def slope_frame(self, si: mi.SurfaceInteraction3f) -> SlopeFrame | None:
        """The frame of a height map's slopes on the surface at ``si``; None for a map of normals,
        which are relative to the shading frame, as in Mitsuba's ``normalmap``."""
        shape = self.map_shape
        if shape is None or self.normal_map is None or not self.normal_map.is_height:
            return None
        height, width, wrap_mode = shape
        return SlopeFrame.from_interaction(si, self.to_uv, width, height, wrap_mode == "mirror")

    def query(
        self,
        si: mi.SurfaceInteraction3f,
        active: bool | mi.Bool = True,
        wi: mi.Vector3f | None = None,
        wo: mi.Vector3f | None = None,
    ) -> Query:
        """The query of an evaluation at ``si``; each evaluation makes one.

        ``wi``, ``wo``: local directions between which a facet reflects; None for any. If they are
        given, the query includes the half vector's turn and the light's extent that ``si`` carries,
        if any.
        """
        self.traverse(RefusesDerivatives(self.owner))
        footprint, parameters = self.footprint(si, active), self.parameters_at(si, mi.Bool(active))
        place = self.place(si)
        carried = Carried.of(si) if self.integrates_lights and wo is not None else None
        if carried is None:
            return Query(footprint, parameters=parameters, place=place)
        # Per UV of the map: H times the inverse of the linear part of to_uv.
        to_uv = mi.AffineTransform3f(self.to_uv).matrix
        inverse = dr.rcp(mi.Matrix2f([[to_uv[0, 0], to_uv[0, 1]], [to_uv[1, 0], to_uv[1, 1]]]))
        turn, spread = carried.turn(si) @ inverse, carried.spread(wi, wo)
        return Query(footprint, turn, spread, parameters, place, carried.shift(wi, wo))

    def parameters_at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Mapping[str, mi.Float]:
        """The values of :attr:`textures` at ``si``, by name, clipped to the parameter's range."""
        values = {}
        for name, texture in self.textures.items():
            allowed = declared_range(self.owner, name)
            value = texture.eval_1(si, active)
            values[name] = dr.clip(value, allowed.minimum, allowed.maximum)
        return values

    def warn_of_point_footprint(self) -> None:
        """Warn, once, that the size of a pixel is unknown, and why."""
        if self.warned_of_point_footprint:
            return
        self.warned_of_point_footprint = True
        reason = (
            'the integrator gives no footprint and "pixel_spread" is 0'
            if is_literal_zero(self.pixel_spread)
            else "the surface does not tell how its UV coordinates change along it, as curves do "
            'not, so that no footprint follows from "pixel_spread"'
        )
        remedy = (
            'Use the integrator "glint_path", with an orthographic camera as well, whose pixels '
            'have no angle; or set "pixel_spread" to the angle of a pixel in radians, as '
            '"glintbsdf render" does where the camera has perspective.'
            if is_literal_zero(self.pixel_spread)
            else "Use a mesh, or a shape of Mitsuba that has a surface."
        )
        warn(
            f'{self.owner} "{self.name}": {reason}, so glints are as fine as the map allows, '
            f"whatever the distance. {remedy}"
        )

    def members(self) -> dict[str, object]:
        """Values for the printed description of this BSDF, by name; None is left out."""
        return {
            "to_uv": None if self.to_uv == type(self.to_uv)() else self.to_uv,
            "footprint_sigma": self.footprint_sigma[0],
            "pixel_spread": self.pixel_spread[0],
        }

    def to_string(self) -> str:
        lines = [
            f"  {name} = {value}".replace("\n", "\n  ")
            for name, value in self.members().items()
            if value is not None
        ]
        return f"{type(self).__name__}[\n" + ",\n".join(lines) + "\n]"


class Facets(NamedTuple):
    """The facets at a surface interaction.

    Attributes:
        pndf (PNDF): the distribution of their normals.
        masking (SmithMasking): their masking and shadowing; None for none.
        tint (mi.UnpolarizedSpectrum): factor on the reflected light.
    """

    pndf: PNDF
    masking: SmithMasking | None
    tint: mi.UnpolarizedSpectrum


class GlintBSDF(FootprintBSDF):
    """A one-sided glossy BRDF, ``F D G / (4 cosθ_i cosθ_o)``, with D the P-NDF of a footprint.

    The base class reads the parameters that all glint BSDFs share and implements Mitsuba's
    interface once. A subclass reads its own parameters in its constructor, which ends with
    :meth:`finish`, and makes its P-NDF in :meth:`create`.

    Attributes:
        pndf (PNDF): the P-NDF. None before it is built: a smooth surface of the map's
            overall roughness then takes its place.
        masking (SmithMasking): masking of the P-NDF's facets; None for none.
        smooth (PNDF): the mean of all glints, which replaces them in a
            ``separation.smooth_context()``; None where the P-NDF is smooth by itself.
        smooth_masking (SmithMasking): masking of the facets of ``smooth``.
        interface (Interface): the optical interface of a facet.

    Raises :class:`~.ParameterError` for values that are not allowed.
    """

    pndf: PNDF | None = None
    masking: SmithMasking | None = None
    smooth: PNDF | None = None
    smooth_masking: SmithMasking | None = None
    masking_name = "none"
    height_correlated = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        self.interface = parameters.interface()
        self.specular_reflectance = parameters.specular_reflectance()
        self.color_conversion: ColorConversion | None = None
        self.m_components = [
            component.flags
            | mi.BSDFFlags.FrontSide
            | mi.BSDFFlags.SpatiallyVarying
            | mi.BSDFFlags.Anisotropic
            | HAS_FOOTPRINT
            for component in self.interface.components
        ]
        self.m_flags = self.m_components[0]
        for flags in self.m_components[1:]:
            self.m_flags |= flags

    def create(self, domain: Domain | None) -> PNDF:
        """Make the P-NDF for queries within ``domain``, or for any."""
        raise NotImplementedError

    def finish(self, method: type[PNDF] = PNDF) -> None:
        """End a subclass's constructor: build, unless ``deferred``.

        ``method``: class of the P-NDF, which states whether it integrates lights, and whether its
        samples alone find the environment.
        """
        reflects = all(
            bool(int(c.flags) & int(mi.BSDFFlags.GlossyReflection))
            for c in self.interface.components
        )
        if method.integrates_lights and reflects:
            self.integrates_lights = True
            able = INTEGRATES_LIGHTS | (FINDS_ENVIRONMENT if method.finds_environment else 0)
            self.m_components = [flags | able for flags in self.m_components]
            self.m_flags |= able
        if not self.deferred:
            in_turn(self.build)
        elif self.normal_map is not None:
            alpha = [max(alpha, MIN_ALPHA) for alpha in self.normal_map.roughness()]
            self.smooth = SmoothBeckmann(lambda: mi.Vector2f(*alpha), owner=self.owner)
            self.smooth_masking = self.smooth.masking("beckmann", False)

    def build(self, domain: Domain | None = None) -> None:
        self.pndf = self.create(domain)
        self.masking = self.pndf.masking(self.masking_name, self.height_correlated)
        self.smooth = self.pndf.smooth()
        self.smooth_masking = None
        if self.smooth is not None:
            self.smooth_masking = self.smooth.masking(self.smooth.maskings[0], False)
        self.color_conversion = None if self.pndf.colors is None else ColorConversion()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if self.pndf is not None:
            self.pndf.traverse(callback)
        super().traverse(callback)
        self.interface.traverse(callback)
        if self.specular_reflectance is not None:
            callback.put(
                "specular_reflectance", self.specular_reflectance, mi.ParamFlags.Differentiable
            )

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        super().parameters_changed(keys)
        for part in (self.pndf, self.masking, self.smooth, self.smooth_masking):
            if part is not None:
                part.parameters_changed(keys)

    # ----------------------------------------------------------------------------------------------
    #  Mitsuba's interface
    # ----------------------------------------------------------------------------------------------

    def facets(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Facets:
        """The facets that reflect at ``si``: the glints, or their smooth counterpart where ``ctx``
        asks for it."""
        if self.pndf is None or (self.smooth is not None and asks_for_smooth_lobes(ctx)):
            facets = Facets(self.smooth, self.smooth_masking, self.mean_tint(si, active))
        else:
            facets = Facets(self.pndf, self.masking, self.tint(si, active))
        frame = self.slope_frame(si)
        if frame is None:
            return facets
        masking = facets.masking and DisplacedMasking(facets.masking, frame)
        return Facets(Displaced(facets.pndf, frame), masking, facets.tint)

    def components(self, ctx: mi.BSDFContext) -> list[tuple[int, Component]]:
        """The components that ``ctx`` asks for, with their indices."""
        return [
            (index, component)
            for index, component in enumerate(self.interface.components)
            if ctx.is_enabled(component.flags, index)
        ]

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: bool | mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        bs, weight = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0)
        components = self.components(ctx)
        # All components are as likely as each other. One alone takes every sample, as it is.
        share = 1 / max(1, len(components))
        for count, (index, component) in enumerate(components):
            chosen, number = mi.Bool(active), sample1
            if share < 1:
                chosen &= (sample1 >= count * share) & (sample1 < (count + 1) * share)
                number = dr.clip((sample1 - count * share) * len(components), 0, 1 - 2**-24)
            sampled = self.sample_component(component, ctx, si, number, sample2, chosen)
            sampled[0].sampled_component = index
            if share < 1:
                sampled[0].pdf *= share
                sampled = (
                    dr.select(chosen, sampled[0], bs),
                    dr.select(chosen, sampled[1] * (1 / share), weight),
                )
            bs, weight = sampled
        return bs, weight

    def sample_component(
        self,
        component: Component,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """``sample`` of one component."""
        bs = dr.zeros(mi.BSDFSample3f)
        active, wi = component.above_horizon(active, si.wi)

        # Draw a normal and scatter at it. One that does not point up, or scatters to the wrong side
        # of the surface, is an invalid sample: its mass is missing from the pdf as well.
        query = self.query(si, active)
        facets = self.facets(ctx, si, active)
        # The sample stays where it is: the derivatives of an estimate are those of its weight.
        m = dr.detach(facets.pndf.sample_visible(wi, query, sample1, sample2, active))
        wo, active = component.scattered(wi, m, active)
        density = self.density(facets.pndf, m, query, si, active)
        pdf = facets.pndf.visible_pdf(wi, m, density, query, active)
        active &= pdf > 0

        bs.wo = wo
        bs.pdf = dr.select(active, component.density_of_direction(pdf, wo, m), 0)
        bs.eta = component.eta
        bs.sampled_type = mi.UInt32(+component.flags)

        value = component.value(density, wi.z)
        drawn = dr.detach(component.density_of_direction(pdf, wo, m))
        weight = value / dr.select(active, drawn, 1)
        return bs, self.scattered(weight, component, facets, ctx, si, wi, wo, m, query, active)

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: bool | mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Float]:
        value, pdf = mi.Spectrum(0), mi.Float(0)
        components = self.components(ctx)
        for count, (_, component) in enumerate(components):
            of_component = self.eval_pdf_component(component, ctx, si, wo, mi.Bool(active))
            value, pdf = (
                of_component if count == 0 else (value + of_component[0], pdf + of_component[1])
            )
        return value, pdf if len(components) < 2 else pdf * (1 / len(components))

    def eval_pdf_component(
        self,
        component: Component,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Float]:
        """``eval_pdf`` of one component."""
        active, wi, wo = component.above_horizon(active, si.wi, wo)
        m = component.half_vector(wi, wo)
        query = self.query(si, active, wi, wo)
        facets = self.facets(ctx, si, active)
        centre = m
        if query.shift is not None:
            centre = normal_from_projection(mi.Vector2f(m.x, m.y) + query.shift)
        density = self.density(facets.pndf, centre, query, si, active)
        value = component.value(density, wi.z)
        pdf = facets.pndf.visible_pdf(wi, m, density, query, active)
        return (
            self.scattered(value, component, facets, ctx, si, wi, wo, m, query, active),
            dr.select(active, component.density_of_direction(pdf, wo, m), 0),
        )

    def eval_diffuse_reflectance(
        self, si: mi.SurfaceInteraction3f, active: bool | mi.Bool = True
    ) -> mi.Spectrum:
        """The albedo for denoisers: tint and reflectance of the macroscopic surface.

        Mitsuba's default, ``π`` times a value of the BRDF, would be the very glints that an albedo
        image must be free of.
        """
        cos_theta_i = mi.Frame3f.cos_theta(si.wi)
        active = mi.Bool(active) & (cos_theta_i > 0)
        albedo = self.mean_tint(si, active)
        if not isinstance(self.interface, Mirror):
            cos_theta_i = dr.select(active, cos_theta_i, 1)
            albedo = albedo * self.interface.reflectance(cos_theta_i, si, active)
        albedo = dr.select(active, albedo, 0)
        return mi.mueller.depolarizer(albedo) if mi.is_polarized else albedo

    # ----------------------------------------------------------------------------------------------
    #  The parts of a value
    # ----------------------------------------------------------------------------------------------

    def density(
        self,
        pndf: PNDF,
        m: mi.Vector3f,
        query: Query,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> mi.Float | mi.UnpolarizedSpectrum:
        """D of the unit normal ``m``: one number, or one per channel for a P-NDF with colours."""
        density = pndf.eval_normal(m, query, active)
        if pndf.colors is None or self.color_conversion is None:
            return density
        return self.color_conversion.eval(density, si, active)

    def tint(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """``specular_reflectance`` at ``si``."""
        if self.specular_reflectance is None:
            return mi.UnpolarizedSpectrum(1)
        return self.specular_reflectance.eval(si, active)

    def mean_tint(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Mean colour of the surface from afar, including colours of the P-NDF itself."""
        tint = self.tint(si, active)
        if self.pndf is None:
            return tint
        if self.pndf.intensity is not None:
            tint = self.pndf.intensity * tint
        if self.color_conversion is not None and self.pndf.colors is not None:
            mean = mi.Color3f(*self.pndf.colors.mean)
            tint = tint * self.color_conversion.eval(mean, si, active)
        return tint

    def scattered(
        self,
        value: mi.Float | mi.UnpolarizedSpectrum,
        component: Component,
        facets: Facets,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        m: mi.Vector3f,
        query: Query,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """``value`` times masking, tint, and what the facet lets through, where active."""
        if facets.masking is not None:
            value = value * facets.masking.eval(wi, component.upward(wo), query, ctx.mode, active)
        spectrum = component.throughput(value * facets.tint, ctx.mode, si, wi, wo, m, active)
        return dr.select(active, spectrum, 0)

    # ----------------------------------------------------------------------------------------------
    #  In words
    # ----------------------------------------------------------------------------------------------

    def parts(self) -> dict[str, int]:
        if self.pndf is None:
            return {}
        return self.pndf.parts() | (self.masking.parts() if self.masking is not None else {})

    def left_out(self) -> list[str]:
        features = {
            "masking: none": self.masking_name != "none",
            "Fresnel reflectance: a perfect mirror": not isinstance(self.interface, Mirror),
            "tint: no specular_reflectance": self.specular_reflectance is not None,
        }
        own = [] if self.pndf is None else self.pndf.left_out()
        return own + [name for name, present in features.items() if not present]

    def members(self) -> dict[str, object]:
        mirror = isinstance(self.interface, Mirror)
        return {
            "pndf": self.pndf,
            "masking": self.masking,
            "interface": None if mirror else self.interface,
            "specular_reflectance": self.specular_reflectance,
            **super().members(),
        }
