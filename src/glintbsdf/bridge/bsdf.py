"""The base classes: BSDFs that see a footprint, and glint BSDFs, microfacet BRDFs around a P-NDF.

``mi.BSDF`` is another class in every variant of Mitsuba, so this module is imported anew for each
(see ``registration.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.separation import asks_for_smooth_lobes
from glintbsdf.bridge.surfaces import doubt_of_green, require_uvs, shapes_of
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Gate, Reach, Recorder, must_wait
from glintbsdf.footprint.gaussian import Footprint, is_literal_zero
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.microfacet import frame as microfacet

#: The most that footprint_sigma and pixel_spread may be set to after loading.
LARGEST = 1e4


class FootprintBSDF(mi.BSDF):
    """A BSDF that depends on the footprint: its parameters, and what follows from them.

    Attributes:
        owner, name (str): type and id of the plugin, as errors and warnings name them.
        to_uv (mi.ScalarAffineTransform3f): transform of UV space.
        footprint_sigma, pixel_spread (mi.Float): see :meth:`Footprint.from_interaction`.
        normal_map (NormalMap): the map, of a BSDF that can tell what of it is asked for.
        watch (Recorder | Gate): who looks at every footprint; nobody by default.
        waits (bool): whether it was made in a block of :func:`~.waiting`.

    Raises :class:`~.ParameterError` for values that are not allowed.
    """

    normal_map: NormalMap | None = None
    watch: Recorder | Gate | None = None

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.waits = must_wait(self)
        self.owner, self.name = props.plugin_name(), props.id()
        parameters = Parameters(props)
        parameters.refuse_unknown()
        self.to_uv = parameters.to_uv()
        self.footprint_sigma = mi.Float(parameters.number("footprint_sigma", 0.5))
        self.pixel_spread = mi.Float(parameters.number("pixel_spread", 0.0))
        self.warned_of_point_footprint = self.looked_at_surfaces = False

    def build(self, reach: Reach | None = None) -> None:
        """Make what queries within ``reach`` need, or any query; whatever there was, goes.

        A subclass that can do so late overrides this, and calls it at its constructor's end unless
        it ``waits``. Here nothing is left to do.
        """

    def parts(self) -> dict[str, int]:
        """Memory of each part of what has been built, bytes."""
        return {}

    def left_out(self) -> list[str]:
        """What the parameters leave out of what is built and evaluated, and why, in words."""
        return []

    def traverse(self, callback: mi.TraversalCallback) -> None:
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        callback.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)
        callback.put("footprint_sigma", self.footprint_sigma, flags)
        callback.put("pixel_spread", self.pixel_spread, flags)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        for key in {"footprint_sigma", "pixel_spread"} & set(keys):
            value = getattr(self, key)
            # Passes of a rendering take pixel_spread beyond the range of its declaration.
            check(
                dr.all((value >= 0) & (value <= LARGEST)),
                self.owner,
                key,
                f"a finite number from 0 to {LARGEST:g}",
                value,
            )

    # A value and its density take one and the same query, in ``eval_pdf``. What a caller does not
    # use, Dr.Jit leaves out of the kernel.
    def eval(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> mi.Spectrum:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
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
        """Look, once, whether the shapes that this BSDF is on fit its map.

        Raises:
            ParameterError: a mesh without UV coordinates.
        """
        if self.looked_at_surfaces:
            return
        self.looked_at_surfaces = True
        shapes = shapes_of(self)
        require_uvs(self.owner, shapes)
        doubt = doubt_of_green(self.normal_map, self.to_uv, shapes)
        if doubt:
            mi.Log(mi.LogLevel.Warn, f'{self.owner} "{self.name}": {doubt}')

    def warn_of_point_footprint(self) -> None:
        """Say, once, that nothing tells how large a pixel is, and why."""
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
        mi.Log(
            mi.LogLevel.Warn,
            f'{self.owner} "{self.name}": {reason}, so glints are as fine as the map allows, '
            f"whatever the distance. {remedy}",
        )

    def members(self) -> dict[str, object]:
        """What describes this BSDF in print, by name; None is left out."""
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
    """What a glint BSDF reflects from: its glints, or the smooth lobe that stands for them.

    Attributes:
        density: the function ``(si, m, footprint, active)`` that gives D of the unit normal m.
        normals: what normals are drawn from, see :class:`~.PndfNormals`.
        masking: :class:`~.SmithMasking`, or None for none.
        tint: the function ``(si, active)`` that gives the factor on the reflection.
    """

    density: Callable
    normals: object
    masking: microfacet.SmithMasking | None
    tint: Callable


class GlintBSDF(FootprintBSDF):
    """A one-sided glossy BRDF, ``F D G / (4 cosθ_i cosθ_o)``, with D the P-NDF of a footprint.

    The base class reads the parameters that all glint BSDFs share and implements Mitsuba's
    interface once. A subclass's constructor calls this one, reads its own parameters, and sets

    Attributes:
        pndf: the P-NDF: ``eval(m, footprint, active)``, the density D over the disk of projected
            normals; ``traverse`` and ``parameters_changed``. None as long as it waits to be built:
            a smooth surface of the map's overall roughness then takes its place.
        masking: :class:`~.SmithMasking`, or None for none.
        smooth: :class:`~.BeckmannLobe` of the roughness that all glints have
            together, which takes their place in a ``separation.smooth_context()``; None (the
            default) where the P-NDF is smooth by itself.

    Normals are drawn by the P-NDF's ``sample(footprint, sample1, sample2, active)``, from exactly
    its density. A subclass whose P-NDF cannot do that overrides :meth:`normals`; one whose density
    has colours overrides :meth:`density`.

    Raises :class:`~.ParameterError` for values that are not allowed.
    """

    pndf: object = None
    masking: microfacet.SmithMasking | None = None
    smooth: microfacet.BeckmannLobe | None = None

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        self.fresnel = parameters.fresnel()
        self.specular_reflectance = parameters.specular_reflectance()

        self.m_flags = (
            mi.BSDFFlags.GlossyReflection
            | mi.BSDFFlags.FrontSide
            | mi.BSDFFlags.SpatiallyVarying
            | mi.BSDFFlags.Anisotropic
        )
        self.m_components = [self.m_flags]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if self.pndf is not None:
            self.pndf.traverse(callback)
        super().traverse(callback)
        if self.fresnel is not None:
            self.fresnel.traverse(callback)
        if self.specular_reflectance is not None:
            callback.put(
                "specular_reflectance", self.specular_reflectance, mi.ParamFlags.Differentiable
            )

    def parameters_changed(self, keys: list[str] = ()) -> None:
        super().parameters_changed(keys)
        if self.pndf is not None:
            self.pndf.parameters_changed(keys)
        for part in (self.masking, self.smooth):
            if part is not None:
                part.parameters_changed()

    def facets(self, ctx: mi.BSDFContext) -> Facets:
        """The glints, or their smooth counterpart where ``ctx`` asks for it."""
        smooth = self.smooth if asks_for_smooth_lobes(ctx) else None
        if self.pndf is None:
            alpha = (max(alpha, 1e-4) for alpha in self.normal_map.roughness())
            smooth = microfacet.BeckmannLobe(mi.Vector2f(*alpha))
        if smooth is not None:
            return Facets(smooth.density, smooth.normals, smooth.masking, self.mean_tint)
        return Facets(self.density, self.normals(), self.masking, self.tint)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        bs = dr.zeros(mi.BSDFSample3f)
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection):
            return bs, mi.Spectrum(0)
        active, wi = microfacet.above_horizon(active, si.wi)

        # Draw a normal and reflect about it. One that does not point up, or reflects below the
        # horizon, is an invalid sample: its mass is missing from the pdf as well.
        footprint = self.footprint(si, active)
        facets = self.facets(ctx)
        m = facets.normals.sample(wi, footprint, sample1, sample2, active)
        wo = mi.reflect(wi, mi.Normal3f(m))
        active &= (m.z > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        density = facets.density(si, m, footprint, active)
        pdf = facets.normals.pdf(wi, m, density, footprint, active)
        active &= pdf > 0

        bs.wo = wo
        bs.pdf = dr.select(active, microfacet.reflected_pdf(pdf, wo, m), 0)
        bs.eta = 1
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.sampled_component = 0

        value = microfacet.reflected_value(density, wi.z)
        weight = value / dr.select(active, microfacet.reflected_pdf(pdf, wo, m), 1)
        return bs, self.reflected(weight, facets, ctx, si, wi, wo, m, footprint, active)

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Float]:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection):
            return mi.Spectrum(0), mi.Float(0)
        active, wi, wo = microfacet.above_horizon(active, si.wi, wo)
        m = microfacet.half_vector(wi, wo)
        footprint = self.footprint(si, active)
        facets = self.facets(ctx)
        density = facets.density(si, m, footprint, active)
        value = microfacet.reflected_value(density, wi.z)
        pdf = facets.normals.pdf(wi, m, density, footprint, active)
        return (
            self.reflected(value, facets, ctx, si, wi, wo, m, footprint, active),
            dr.select(active, microfacet.reflected_pdf(pdf, wo, m), 0),
        )

    def eval_diffuse_reflectance(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        """The albedo for denoisers: tint and Fresnel reflectance of the macroscopic surface.

        Mitsuba's default, ``π`` times a value of the BRDF, would be the very glints that an albedo
        image must be free of.
        """
        cos_theta_i = mi.Frame3f.cos_theta(si.wi)
        active = mi.Bool(active) & (cos_theta_i > 0)
        albedo = self.mean_tint(si, active)
        if self.fresnel is not None:
            cos_theta_i = dr.select(active, cos_theta_i, 1)
            albedo = albedo * self.fresnel.reflectance(cos_theta_i, si, active)
        albedo = dr.select(active, albedo, 0)
        return mi.mueller.depolarizer(albedo) if mi.is_polarized else albedo

    def density(
        self, si: mi.SurfaceInteraction3f, m: mi.Vector3f, footprint: Footprint, active: mi.Bool
    ) -> mi.Float | mi.UnpolarizedSpectrum:
        """D of the unit normal ``m``: one number, or one per channel for a P-NDF with colours."""
        return self.pndf.eval(mi.Vector2f(m.x, m.y), footprint, active)

    def normals(self) -> microfacet.PndfNormals:
        """What normals are drawn from: an object with the methods of ``PndfNormals``."""
        return microfacet.PndfNormals(self.pndf)

    def tint(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """``specular_reflectance`` at ``si``."""
        if self.specular_reflectance is None:
            return mi.UnpolarizedSpectrum(1)
        return self.specular_reflectance.eval(si, active)

    def mean_tint(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """What tints the surface as seen from afar, where the P-NDF may have colours of its own."""
        return self.tint(si, active)

    def reflected(
        self,
        value: mi.Float | mi.UnpolarizedSpectrum,
        facets: Facets,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        m: mi.Vector3f,
        footprint: Footprint,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """``value`` times masking, tint and Fresnel reflectance or Mueller matrix, where active."""
        if facets.masking is not None:
            value = value * facets.masking.eval(wi, wo, footprint, active)
        tint = facets.tint(si, active)
        if mi.is_polarized:
            spectrum = microfacet.mueller_reflection(
                self.fresnel.index(si, active), value * tint, ctx.mode, wi, wo, m
            )
        else:
            spectrum = value * tint
            if self.fresnel is not None:
                spectrum = spectrum * self.fresnel.reflectance(dr.dot(wo, m), si, active)
        return dr.select(active, spectrum, 0)

    def parts(self) -> dict[str, int]:
        if self.pndf is None:
            return {}
        parts = dict(getattr(self.pndf, "parts", {"P-NDF": self.pndf.nbytes}))
        if self.pndf.nbytes > sum(parts.values()):
            parts["else"] = self.pndf.nbytes - sum(parts.values())
        return parts | getattr(self.masking, "parts", {})

    def left_out(self) -> list[str]:
        features = {
            "masking: none": self.masking,
            "Fresnel reflectance: a perfect mirror": self.fresnel,
            "tint: no specular_reflectance": self.specular_reflectance,
        }
        return [name for name, feature in features.items() if feature is None]

    def members(self) -> dict[str, object]:
        return {
            "pndf": self.pndf,
            "masking": self.masking,
            "fresnel": self.fresnel,
            "specular_reflectance": self.specular_reflectance,
            **super().members(),
        }
