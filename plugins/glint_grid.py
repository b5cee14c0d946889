r"""
.. _bsdf-glint_grid:

Procedural glints and grooves (:monosp:`glint_grid`)
----------------------------------------------------

.. pluginparameters::

 * - alpha, or alpha_u and alpha_v
   - |float|
   - Beckmann roughness of the surface as it looks from afar, along both or each of the axes u and
     v, at least :monosp:`1e-4`. (Default: 0.3)
   - |exposed|, |differentiable|

 * - detail_alpha, or detail_alpha_u and detail_alpha_v
   - |float|
   - Roughness of a single microdetail: greater than 0, and at most that of the surface. Where it is
     equal to the surface's along one axis, microdetails become endless grooves along that axis.
     (Default: 0.05)
   - |exposed|

 * - density
   - |float|
   - Decimal logarithm of the number of microdetails per unit of UV area, from -20 to 20. One of
     them is as wide as :monosp:`10^(-density/2)` in UV. (Default: 8)
   - |exposed|

 * - size_variation
   - |float|
   - Standard deviation, at least 0, of the number of microdetails in equal areas, relative to its
     mean: some places have many small ones, others a few large. (Default: 0.3)
   - |exposed|

 * - intensity
   - |float|
   - Factor on all of the reflection, at least 0. Above 1 the surface may reflect more than it
     receives. (Default: 1)
   - |exposed|, |differentiable|

 * - light_spread
   - |float|
   - Half angle of the cone, in radians from 0 to less than :math:`\pi/2`, that the light fills as
     seen from the surface. A wide light finds more microdetails that mirror it, so that glints grow
     weaker and the surface smoother. What the light's shape does to its highlight is the
     renderer's part. (Default: 0, a point)
   - |exposed|

 * - colors
   - |string| or :monosp:`mitsuba.Bitmap`
   - Colours of the microdetails: :monosp:`none`; :monosp:`wheel`, all hues, which together make
     white; or a palette, each pixel of an image being as likely as the others: the name of a file,
     relative to the scene's folder, or a bitmap. From afar the surface has the palette's mean
     colour. (Default: :monosp:`none`)

 * - max_anisotropy
   - |float|
   - Largest ratio, at least 1, of the length and width of a pixel on the surface that is resolved;
     beyond it, at grazing angles, pixels count as wider. Limits the cost. (Default: 16)
   - |exposed|

 * - seed
   - |int|
   - Another number gives other microdetails. (Default: 0)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. The axes of the roughness stay those
     of the surface: grooves need a transform that does not rotate. (Default: none)
   - |exposed|

 * - footprint_sigma
   - |float|
   - Standard deviation of the footprint in pixels; the pixel is taken to be two of them wide.
     (Default: 0.5)
   - |exposed|

 * Shared: pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

Glitter, snow, sand and brushed metal from a few parameters: no map, no memory, no precomputation.
Microdetails, each a small lobe of roughness :monosp:`detail_alpha`, are strewn over the surface and
over the directions that they face, so that all together make the Beckmann lobe of roughness
:monosp:`alpha` :cite:`Zirr16Multiscale`. Where a pixel covers few of them they show as glints, or,
long along one axis, as grooves; where it covers many, the surface is that of
:monosp:`roughconductor` with the distribution :monosp:`beckmann`. Their positions belong to the UV
coordinates, whatever the camera does, and the number that reflects in a pixel is drawn at random,
but always alike, from hashed numbers of the cells that the pixel covers, on a hierarchy of grids:

.. math::

    D(m) = D_g(m) \sum_C w_C \frac{n_C}{N_C P(m)}, \qquad
    n_C \sim B(N_C, P(m)), \qquad P(m) = \frac{D_g(m)}{D_l(0)}

with weights :math:`w_C` of the cells that add up to one, :math:`N_C` microdetails in a cell, of
which :math:`n_C` reflect. On average over places :math:`D = D_g` exactly. A single place is *not*
normalised: too many microdetails in one direction are not made up for in others, and it may reflect
more than it receives. Sampling draws from the visible normals of the smooth surface; the weight of
a sample holds the glints.

Stretched UV coordinates stretch microdetails, and what is finer than four spacings of float32 UV
coordinates is not resolved. Derivatives with respect to roughness are those of the smooth surface
times the glints, which stay; they are exact on average.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_grid

        <bsdf type="glint_grid">
            <float name="alpha" value="0.4"/>
            <float name="detail_alpha" value="0.03"/>
            <float name="density" value="6.5"/>
            <string name="colors" value="wheel"/>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        'type': 'glint_grid',
        'alpha': 0.4,
        'detail_alpha': 0.03,
        'density': 6.5,
        'colors': 'wheel',
        'material': 'Al'

Reference: Tobias Zirr and Anton S. Kaplanyan, "Real-time Rendering of Procedural Multiscale
Materials" (:cite:`Zirr16Multiscale`).
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.pndf import Grid
from glintbsdf.pndf.grid.microdetails import Palette, Wheel


class GlintGrid(GlintBSDF):
    """The plugin ``glint_grid``."""

    masking_name = "beckmann"
    height_correlated = False  # as roughconductor

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        colors = parameters.colors("colors", ("none", "wheel"))
        if isinstance(colors, str):
            colors = {"none": None, "wheel": Wheel()}[colors]
        else:
            colors = Palette(colors)
        alpha = parameters.per_axis("alpha", 0.3)
        detail_alpha = parameters.per_axis("detail_alpha", 0.05)
        for axis, whole, detail in zip("uv", alpha, detail_alpha, strict=True):
            names = parameters.written("alpha", axis), parameters.written("detail_alpha", axis)
            if names[1] in props:
                requirement = f'at most "{names[0]}" = {whole:g}'
                check(detail <= whole, self.owner, names[1], requirement, detail)
            requirement = f'at least "{names[1]}" = {detail:g}'
            check(detail <= whole, self.owner, names[0], requirement, whole)
        self.options = {
            "alpha": alpha,
            "detail_alpha": detail_alpha,
            "density": parameters.number("density", 8.0),
            "size_variation": parameters.number("size_variation", 0.3),
            "intensity": parameters.number("intensity", 1.0),
            "light_spread": parameters.number("light_spread", 0.0),
            "colors": colors,
            "max_anisotropy": parameters.number("max_anisotropy", 16.0),
            "seed": parameters.whole("seed", 0),
            "owner": self.owner,
        }
        # Nothing is stored: there is nothing to wait for.
        self.build()

    def create(self, domain: Domain | None) -> Grid:
        return Grid(**self.options)


register_plugin("glint_grid", GlintGrid)
