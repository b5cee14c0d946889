r"""
.. _bsdf-glint_filtered:

Smooth filters of a normal map (:monosp:`glint_filtered`)
---------------------------------------------------------

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - method
   - |string|
   - The filter: :monosp:`toksvig`, :monosp:`lean`, :monosp:`clean`, :monosp:`leadr` or
     :monosp:`variance`, see below. (Default: :monosp:`lean`)

 * - alpha
   - |float|
   - Roughness of the material itself, > 0; up to 1 for :monosp:`toksvig`. (Default: 0.05)
   - |exposed|, |differentiable|

 * - distribution
   - |string|
   - Shape of the lobe: :monosp:`beckmann`, or for :monosp:`toksvig` and :monosp:`variance` also
     :monosp:`ggx`. (Default: :monosp:`beckmann`)

 * - max_anisotropy
   - |float|
   - Ratio of a footprint's axes, ≥ 1, beyond which it is widened along the minor axis. The number
     of lookups along the major axis grows with the ratio; 1 makes all footprints round.
     (Default: 16)

 * - masking
   - |string|
   - Masking and shadowing by the facets of the lobe: :monosp:`footprint`, over the mean facet,
     LEADR's rule, for all methods; :monosp:`smith`, with the geometric surface in the reflection,
     so that a footprint which leans towards the viewer reflects more light than it receives; or
     :monosp:`none`. With :monosp:`leadr`, :monosp:`smith` is :monosp:`footprint`, and there is no
     :monosp:`none`. (Default: :monosp:`footprint`)

 * - height_correlated
   - |bool|
   - Whether masking and shadowing are correlated by height, rather than independent.
     (Default: |true|)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

A normal map seen from afar, filtered as games and films do it today: one smooth lobe per footprint.
Where a pixel covers many thousands of bumps this is all there is to see, at a small part of the
price of the glints' methods; nearer by it is the baseline that they are measured against. All
methods average moments of the normals over the whole footprint, however stretched or rotated, from
a MIP chain that holds no more than the method needs:

.. list-table::
    :widths: 15 85

    * - :monosp:`toksvig`
      - From the length of the mean normal, isotropic :cite:`Toksvig2005`
    * - :monosp:`lean`
      - Mean and covariance of the slopes, an off-centred anisotropic lobe :cite:`Olano2010LEAN`
    * - :monosp:`clean`
      - As LEAN, with one variance for all directions :cite:`Baker2011CLEAN`
    * - :monosp:`leadr`
      - LEAN, with the masking and the projected area of its lobe :cite:`Dupuy2013LEADR`, which
        here is the default for all of them: never reflects more light than arrives
    * - :monosp:`variance`
      - Roughness along u and v per MIP texel, from the variance lost there; what texture filtering
        between texels loses is not counted :cite:`RTR4`, section 9.13.1

The mean normal of a footprint moves the lobe off the geometric normal. Normals are drawn from those
that the viewer sees. The moments are those of the map under the footprint to 1 % from a standard
deviation of 1.2 texels on; smaller footprints mix the texels' own moments, as texture filtering
does, and look rougher than the interpolated normals are.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_filtered

        <bsdf type="glint_filtered">
            <string name="filename" value="scratches.exr"/>
            <string name="method" value="leadr"/>
            <float name="alpha" value="0.02"/>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        'type': 'glint_filtered',
        'filename': 'scratches.exr',
        'method': 'leadr',
        'alpha': 0.02,
        'material': 'Al'

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
        self.options = {
            "method": method,
            "alpha": parameters.number("alpha", 0.05),
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
        self.finish()

    def create(self, domain: Domain | None) -> Filtered:
        return Filtered(self.normal_map, domain=domain, **self.options)


register_plugin("glint_filtered", GlintFiltered)
