r"""
.. _bsdf-glint_filtered:

Smooth filters of a normal map (:monosp:`glint_filtered`)
---------------------------------------------------------

A normal map as one smooth highlight for each pixel, as games and films have it.

.. pluginpictures::

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - method
   - |string|
   - The filter: :monosp:`toksvig`, :monosp:`lean`, :monosp:`clean`, :monosp:`leadr` or
     :monosp:`variance`, see below. (Default: :monosp:`lean`)

 * - alpha
   - |float| or |texture|
   - Base roughness of the material, > 0, and at most 1 for :monosp:`toksvig`. Values of a texture
     are clipped to [0.0001, 10]. (Default: 0.05)
   - |exposed|, |differentiable|

 * - distribution
   - |string|
   - Shape of the lobe: :monosp:`beckmann`; :monosp:`toksvig` and :monosp:`variance` also allow
     :monosp:`ggx`. (Default: :monosp:`beckmann`)

 * - max_anisotropy
   - |float|
   - Largest ratio of a footprint's axes, ≥ 1. Longer footprints are widened along their minor axis.
     The number of lookups along the major axis grows with the ratio; 1 makes all footprints round.
     (Default: 16)

 * - masking
   - |string|
   - Masking and shadowing by the facets of the lobe. :monosp:`footprint`: LEADR's rule for all
     methods, relative to the mean facet. :monosp:`smith`: with the cosine of the geometric surface
     in the BRDF; a footprint that leans towards the viewer then reflects more light than it
     receives. :monosp:`none`: no masking. With :monosp:`leadr`, :monosp:`smith` is the same as
     :monosp:`footprint`, and :monosp:`none` is an error. (Default: :monosp:`footprint`)

 * - height_correlated
   - |bool|
   - Whether masking and shadowing are correlated by height; otherwise they are independent.
     (Default: |true|)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

This BSDF filters a normal map to one smooth lobe per footprint, as games and films do today. Where
a pixel covers many thousands of bumps, there is nothing more to see, and a lobe costs a small part
of the time of the methods for glints. For smaller footprints it is the baseline for these methods.
All filters average moments of the normals over the whole footprint, however stretched or rotated it
is. The averages come from a MIP chain of the moments that the filter needs:

.. list-table::
    :widths: 15 85

    * - :monosp:`toksvig`
      - An isotropic lobe from the length of the mean normal :cite:`Toksvig2005`
    * - :monosp:`lean`
      - An off-centre anisotropic lobe from mean and covariance of the slopes
        :cite:`Olano2010LEAN`
    * - :monosp:`clean`
      - As LEAN, with the same variance in all directions :cite:`Baker2011CLEAN`
    * - :monosp:`leadr`
      - LEAN, with masking by the projected area of its lobe :cite:`Dupuy2013LEADR`. It never
        reflects more light than arrives. Here this masking is the default for all filters
    * - :monosp:`variance`
      - Roughness along u and v, from the variance of slopes within each MIP texel; the variance
        between texels does not count :cite:`RTR4`, section 9.13.1

The mean normal of a footprint moves the lobe away from the geometric normal. The sampler draws
visible normals. From a standard deviation of 1.2 texels on, the moments are accurate to 1 %.
Smaller footprints mix the moments of the texels, as texture filtering does, and look rougher than
the interpolated normals.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_filtered

        <bsdf type="glint_filtered">
            <string name="filename" value="scratched.exr"/>
            <string name="method" value="leadr"/>
            <float name="alpha" value="0.02"/>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_filtered',
            'filename': 'scratched.exr',
            'method': 'leadr',
            'alpha': 0.02,
            'material': 'Al',
        })

Reference: Tomas Akenine-Möller et al., "Real-Time Rendering", 4th edition, section 9.13.1
(:cite:`RTR4`).
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.microfacet.slope_distribution import DISTRIBUTIONS
from glintbsdf.pndf.filters.filters import METHODS, Filtered


class GlintFiltered(GlintBSDF):
    """The plugin ``glint_filtered``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        method = parameters.choice("method", "lean", tuple(METHODS))
        self.normal_map = parameters.normal_map()
        alpha = parameters.number_or_texture("alpha", 0.05)
        if isinstance(alpha, mi.Texture):
            self.textures, alpha = {"alpha": alpha}, None
        self.options = {
            "method": method,
            "alpha": alpha,
            "distribution": parameters.choice("distribution", "beckmann", DISTRIBUTIONS),
            "max_anisotropy": parameters.number("max_anisotropy", 16.0),
            "owner": self.owner,
        }
        self.masking_name = parameters.choice("masking", Filtered.maskings[0], Filtered.maskings)
        check(
            self.masking_name != "none" or method != "leadr",
            self.owner,
            "masking",
            "footprint for leadr, whose part it is",
            self.masking_name,
        )
        self.height_correlated = parameters.boolean("height_correlated", True)
        self.finish(Filtered)

    def create(self, domain: Domain | None) -> Filtered:
        return Filtered(self.normal_map, domain=domain, **self.options)


register_plugin("glint_filtered", GlintFiltered)
