r"""
.. _bsdf-glint_grid:

Procedural glints and grooves (:monosp:`glint_grid`)
----------------------------------------------------

Glitter, snow, sand and brushed metal from a few numbers, without a map.

.. pluginpictures::

.. pluginparameters::

 * - alpha, or alpha_u and alpha_v
   - |float|
   - Beckmann roughness of the whole surface, as it looks from afar; for both axes, or for u and v,
     at least :monosp:`1e-4`. (Default: 0.3)
   - |exposed|, |differentiable|

 * - detail_alpha, or detail_alpha_u and detail_alpha_v
   - |float|
   - Roughness of a single microdetail: greater than 0, and at most :monosp:`alpha`. If it is equal
     to :monosp:`alpha` along one axis, microdetails become endless grooves along that axis.
     (Default: 0.05)
   - |exposed|

 * - density
   - |float|
   - Decimal logarithm of the number of microdetails per unit of UV area, from -20 to 20. A
     microdetail is about :monosp:`10^(-density/2)` wide in UV. (Default: 8)
   - |exposed|, |differentiable|

 * - size_variation
   - |float|
   - Standard deviation, at least 0, of the number of microdetails in equal areas, relative to the
     mean number: some places have many small ones, others a few large ones. (Default: 0.3)
   - |exposed|

 * - intensity
   - |float|
   - Factor on the reflection, at least 0. With a factor above 1 the surface may reflect more light
     than it receives. (Default: 1)
   - |exposed|, |differentiable|

 * - light_spread
   - |float|
   - Half angle of the cone that the light fills, as seen from the surface, in radians from 0 to
     less than :math:`\pi/2`. More microdetails reflect a wide light, so glints are weaker and the
     surface looks smoother. The blur of the highlight by the light's shape is left to the
     integrator. :ref:`glint_path <integrator-glint_path>` integrates small lights as they are, and
     needs none of it. (Default: 0, a point)
   - |exposed|

 * - colors
   - |string| or :monosp:`mitsuba.Bitmap`
   - Colours of the microdetails: :monosp:`none`; :monosp:`wheel`, all hues, whose mean is white; or
     a palette, which is an image whose pixels are equally likely. The image is a file, relative to
     the scene's folder, or a bitmap. From afar the surface has the palette's mean colour.
     (Default: :monosp:`none`)

 * - max_anisotropy
   - |float|
   - Largest ratio, at least 1, of the length and the width of a pixel on the surface. Pixels that
     are longer, at grazing angles, count as wider than they are. This limits the cost.
     (Default: 16)
   - |exposed|

 * - seed
   - |int|
   - Seed of the microdetails. (Default: 0)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. The axes of the roughness do not turn
     with it, so grooves need a transform that does not rotate. (Default: none)
   - |exposed|

 * - footprint_sigma
   - |float|
   - Standard deviation of the footprint in pixels. A pixel counts as two standard deviations wide.
     (Default: 0.5)
   - |exposed|

 * Shared: pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

This BSDF renders glitter, snow, sand and brushed metal from a few parameters, without a map, memory
or precomputation. The surface is covered with microdetails, each of which is a small lobe of
roughness :monosp:`detail_alpha`. The directions that they face are random. All together they make
the Beckmann lobe of roughness :monosp:`alpha` :cite:`Zirr16Multiscale`. Where a pixel covers a few
microdetails, they are visible as glints, or as grooves if they are long along one axis. Where a
pixel covers many, the surface looks like :monosp:`roughconductor` with the distribution
:monosp:`beckmann`. Microdetails are fixed in UV space, wherever the camera is. The number of
microdetails that reflect in a pixel is random but repeatable: it comes from hashes of the cells
that the pixel covers, on a hierarchy of grids.

.. math::

    D(m) = D_g(m) \sum_C w_C \frac{n_C}{N_C P(m)}, \qquad
    n_C \sim B(N_C, P(m)), \qquad P(m) = \frac{D_g(m)}{D_l(0)}

Here :math:`w_C` are weights of the cells, which add up to one. A cell has :math:`N_C` microdetails,
of which :math:`n_C` reflect. The mean of :math:`D` over all places is exactly :math:`D_g`. A single
place is *not* normalised: a surplus of microdetails in one direction is not compensated in others,
so the place may reflect more light than it receives. The sampler draws visible normals of the
smooth surface, and the glints are in the weight of a sample.

*Lights.* :ref:`glint_path <integrator-glint_path>` lets it integrate small lights. Under a light
:math:`D` is its mean over the ellipse of half vectors that the light covers, cell by cell of the
half vectors in which microdetails are counted, up to four by four of them. Where there are more, a
cell stands for several, with a weight that keeps mean and variance. Along a long footprint, each
cell of the surface has a half vector of its own.

Stretched UV coordinates stretch microdetails. Microdetails finer than four spacings of float32 UV
coordinates are not resolved.

*Derivatives* are right on average over places. Those with respect to roughness and
:monosp:`intensity` are those of the smooth surface times the glints, which stay. The mean over
places does not depend on :monosp:`density`, but the contrast of glints does: denser microdetails
are smaller ones, so that its derivative is that of a footprint which grows among them. It is right
for whatever is computed from the footprint of one sample, and leaves out what the samples of one
pixel differ by their places. :monosp:`detail_alpha`, :monosp:`size_variation`,
:monosp:`light_spread` and :monosp:`max_anisotropy` have no derivatives and say so when asked.

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

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_grid',
            'alpha': 0.4,
            'detail_alpha': 0.03,
            'density': 6.5,
            'colors': 'wheel',
            'material': 'Al',
        })

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
from glintbsdf.pndf.colors import Palette, Wheel


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
        self.finish(Grid)

    def create(self, domain: Domain | None) -> Grid:
        return Grid(**self.options)


register_plugin("glint_grid", GlintGrid)
