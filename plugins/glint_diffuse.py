r"""
.. _bsdf-glint_diffuse:

Diffuse facets of a normal map (:monosp:`glint_diffuse`)
--------------------------------------------------------

A matt surface with a normal map, which neither flickers nor turns flat in the distance.

.. pluginpictures::

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - reflectance
   - |spectrum| or |texture|
   - Reflectance of the facets, in [0, 1]. (Default: 0.5)
   - |exposed|, |differentiable|

 * - method
   - |string|
   - :monosp:`manifold`: a sum over all facets under the footprint. :monosp:`oren_nayar`: Oren and
     Nayar's model around the mean normal of these facets, with their roughness; it is faster, but
     does not resolve features within a pixel. (Default: :monosp:`manifold`)

 * Shared: footprint_sigma, pixel_spread

This BSDF is a diffuse surface with a normal map, without aliasing. The usual way, :monosp:`diffuse`
inside :monosp:`normalmap`, looks up one normal of the pixel's footprint per sample. This BSDF
integrates the light that all facets under the footprint reflect :cite:`Wu24Glint`:

.. math::

    f_d = \frac{P(\omega)}{\pi\,\omega_z}, \qquad
    P(\omega) = \int D(m) \max(m \cdot \omega, 0)\,\mathrm{d}m,

Here :math:`\omega` points to the light, and :math:`P` is the projected area of the facets, which
has a closed form for each triangle of the map. Samples follow the cosine to the surface.

A facet counts with its own area, which is larger than the area of the surface below it. Facets
neither hide nor light each other. So a steep map reflects more than :monosp:`reflectance`, by a
quarter of the mean squared slope.

For footprints of up to 4096 texels, the sum has all facets. For larger ones it has about as many,
distributed evenly. So the cost of a large footprint is bounded, but high.

The material is one-sided: use the ``twosided`` adapter for both sides. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_diffuse

        <bsdf type="glint_diffuse">
            <string name="filename" value="scratched.exr"/>
            <rgb name="reflectance" value="0.8, 0.7, 0.6"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_diffuse',
            'filename': 'scratched.exr',
            'reflectance': {'type': 'rgb', 'value': [0.8, 0.7, 0.6]},
        })

Reference: Liwen Wu, Fujun Luan, Miloš Hašan and Ravi Ramamoorthi, "Position-Normal Manifold for
Efficient Glint Rendering on High-Resolution Normal Maps" (:cite:`Wu24Glint`), section 4.3 and, for
:monosp:`oren_nayar`, appendix C.
"""

from __future__ import annotations

from math import pi

import drjit as dr
import mitsuba as mi

from glintbsdf.bridge.bsdf import FootprintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.footprint.domain import Domain
from glintbsdf.microfacet.frame import above_horizon
from glintbsdf.pndf.manifold.diffuse import FacetDiffuse, OrenNayarDiffuse
from glintbsdf.pndf.manifold.mesh import TexelMesh
from glintbsdf.pndf.sharing import in_turn

METHODS = ("manifold", "oren_nayar")


class GlintDiffuse(FootprintBSDF):
    """The plugin ``glint_diffuse``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        self.normal_map = parameters.normal_map()
        self.mesh = TexelMesh(self.normal_map, owner=self.owner)
        self.reflectance = parameters.spectrum("reflectance", 0.5, maximum=1.0)
        self.method_name = parameters.choice("method", "manifold", METHODS)
        self.method = None
        self.m_flags = (
            mi.BSDFFlags.DiffuseReflection
            | mi.BSDFFlags.FrontSide
            | mi.BSDFFlags.SpatiallyVarying
            | mi.BSDFFlags.Anisotropic
        )
        self.m_components = [self.m_flags]
        if not self.deferred:
            in_turn(self.build)

    def build(self, domain: Domain | None = None) -> None:
        if self.method_name == "manifold":
            self.method = FacetDiffuse(self.mesh)
        else:
            self.method = OrenNayarDiffuse(self.mesh, domain)

    def remedies(self) -> list[str]:
        return ['"method" oren_nayar visits no triangle'] if self.method_name == "manifold" else []

    def parts(self) -> dict[str, int]:
        return self.mesh.parts() | (self.method.parts() if self.method is not None else {})

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.mesh.traverse(callback)
        super().traverse(callback)
        callback.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        super().parameters_changed(keys)
        self.mesh.parameters_changed(keys)
        if self.method is not None and (not keys or "data" in keys):
            self.method.parameters_changed()

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        bs = dr.zeros(mi.BSDFSample3f)
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection):
            return bs, mi.Spectrum(0)
        bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        bs.eta = 1
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        bs.sampled_component = 0
        return bs, value / dr.select(bs.pdf > 0, bs.pdf, 1)

    def eval_pdf(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Float]:
        if not ctx.is_enabled(mi.BSDFFlags.DiffuseReflection):
            return mi.Spectrum(0), mi.Float(0)
        active, wi, wo = above_horizon(active, si.wi, wo)
        query = self.query(si, active)
        white = wo.z * (1 / pi)  # a plain diffuse surface, before anything is built
        if self.method is not None:
            frame = self.slope_frame(si)
            white = self.method.eval(wi, wo, ctx.mode, query, active, frame)
        value = dr.select(active, self.reflectance.eval(si, active) * white, 0)
        pdf = dr.select(active, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)
        return mi.mueller.depolarizer(value) if mi.is_polarized else value, pdf

    def eval_diffuse_reflectance(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        albedo = self.reflectance.eval(si, active)
        return mi.mueller.depolarizer(albedo) if mi.is_polarized else albedo

    def members(self) -> dict[str, object]:
        return {
            "mesh": self.mesh,
            "method": self.method,
            "reflectance": self.reflectance,
            **super().members(),
        }


register_plugin("glint_diffuse", GlintDiffuse)
