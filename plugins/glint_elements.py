r"""
.. _bsdf-glint_elements:

Glints of Gaussian elements (:monosp:`glint_elements`)
------------------------------------------------------

A surface with the normals of a map, or with metallic flakes, whose glints have a roughness.

.. pluginpictures::

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - sigma_r
   - |float|
   - Intrinsic roughness: the standard deviation of a projected normal, in [1e-8, 1]. This is the
     width of a glint from a flat part of the map. Half vectors in single precision resolve widths
     down to 1e-7. (Default: 0.005)
   - |exposed|, |differentiable|

 * - step
   - |float|
   - Distance of neighbouring elements, in texels: 0.5 for accuracy, 1 for speed. It is rounded so
     that a whole number of steps makes the map. (Default: 0.5)

 * - elements
   - |string|
   - :monosp:`curved`: elements follow the map's Jacobian. :monosp:`flat`: each element has a single
     normal, like a facet of a rugged surface. (Default: :monosp:`curved`)

 * - flake_density
   - |float|
   - Number of metallic flakes per unit of UV area; they take the place of a map. Flakes are placed
     by a Poisson-disk pattern on the unit UV square, which repeats. Another
     density scatters other flakes. Its derivative is right on average over places, see below.
   - |exposed|, |differentiable|

 * - flake_alpha
   - |float|
   - Beckmann roughness from which each flake draws its normal. Its derivatives are those of flakes
     that turn where they are, all slopes in proportion to it. (Default: 0.2)
   - |exposed|, |differentiable|

 * - seed
   - |int|
   - Seed of the flakes. (Default: 0)

 * - masking
   - |string|
   - Masking and shadowing. :monosp:`footprint`: by the elements under the footprint, relative to
     the plane of their mean slope, so that no place reflects more light than it receives.
     :monosp:`beckmann`: the paper's masking, of a level Beckmann surface with the roughness of the
     whole map, or of all flakes; a place that leans towards the viewer then reflects more than it
     receives. :monosp:`none`: no masking. (Default: :monosp:`footprint`)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

This BSDF renders the glints of a surface whose normals come from a high-resolution map, or from
metallic flakes. As in :cite:`Yan2016`, the surface is a mixture of *elements*. These are Gaussians
in position × normal space, :monosp:`step` texels apart, each aligned with the normals of the map
around it. The P-NDF, the distribution of the normals under a pixel's footprint, is then a sum in
closed form:

.. math::

    D(m) = \frac{1}{W} \sum_i w_i\, \mathcal{N}(m;\ s_i + J_i \mu_i,\ \sigma_r^2 I + J_i C J_i^T)

Here :math:`w_i` is the mass of element :math:`i` under the footprint. :math:`\mu_i` and :math:`C`
are the mean and the covariance of the positions, relative to the element, at which the footprint
sees it, and :math:`W = \sum_i w_i`. Samples have this density, within 1e-3. It is smooth, unlike
that of :ref:`glint_manifold <bsdf-glint_manifold>`, as it includes the roughness
:math:`\sigma_r`.

Elements are not stored, but computed from the texels around them. A map takes 8 bytes per texel.
Large footprints are evaluated from lists of elements by normal, which take up to 96 bytes per
texel, or 42 with a :monosp:`step` of 1. The moments of slopes that mask large footprints take 10
bytes. The time of a query grows with the area of the footprint.

The sum is cut where elements weigh little: around 3 standard deviations from the footprint's
centre, where their weight falls to 0, and at 3.94 standard deviations of an element's normals. The
integral of :math:`D` is one within 1e-3 for every footprint.

Flakes cover the whole surface. From afar they cover it evenly, and a point shows the nearest ones.
To show a base coat between flakes, blend with its material (``blendbsdf``).

*Derivatives with respect to* :monosp:`flake_density`. Flakes do not appear by degrees. But on
average over places, denser flakes are smaller ones, and what a footprint sees of them depends on
their relative size: the derivative is that of a footprint which grows among the flakes. It is right
for averages over many places of whatever is computed from the footprint of one sample, such as the
contrast of glints; it leaves out what the samples of one pixel differ by their places, a quarter of
it with a :monosp:`footprint_sigma` of 0.5. Compare statistics of pictures, not single pixels.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_elements

        <bsdf type="glint_elements">
            <string name="filename" value="scratched.exr"/>
            <transform name="to_uv">
                <scale x="4" y="4"/>
            </transform>
            <float name="sigma_r" value="0.005"/>
            <string name="material" value="Al"/>
        </bsdf>

        <bsdf type="glint_elements">
            <float name="flake_density" value="3e4"/>
            <float name="flake_alpha" value="0.15"/>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_elements',
            'filename': 'scratched.exr',
            'to_uv': mi.ScalarTransform4f().scale([4, 4, 1]),
            'sigma_r': 0.005,
            'material': 'Al',
        })

Reference: Ling-Qi Yan, Miloš Hašan, Steve Marschner and Ravi Ramamoorthi, "Position-Normal
Distributions for Efficient Rendering of Specular Microstructure" (:cite:`Yan2016`),
section 5.
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import MAP_SOURCES, Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.footprint.domain import Domain
from glintbsdf.pndf import Elements, Flakes


class GlintElements(GlintBSDF):
    """The plugin ``glint_elements``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        parameters.only_one_of(MAP_SOURCES, ("flake_density",))
        self.options = {"sigma_r": parameters.number("sigma_r", 0.005), "owner": self.owner}
        self.masking_name = parameters.choice("masking", Elements.maskings[0], Elements.maskings)
        if "flake_density" in props:
            self.options |= {
                "density": parameters.number("flake_density", 0.0),
                "alpha": parameters.number("flake_alpha", 0.2),
                "seed": parameters.whole("seed", 0),
            }
        else:
            self.normal_map = parameters.normal_map(instead="flake_density")
            elements = parameters.choice("elements", "curved", ("curved", "flat"))
            self.options |= {
                "step": parameters.number("step", 0.5),
                "curved": elements == "curved",
            }
        self.finish(Flakes if self.normal_map is None else Elements)

    def create(self, domain: Domain | None) -> Elements | Flakes:
        if self.normal_map is None:
            return Flakes(**self.options)
        return Elements(self.normal_map, domain=domain, **self.options)

    def remedies(self) -> list[str]:
        if self.normal_map is None:
            return []
        return ['glint_manifold with "max_error" 0.05 bounds the cost of wide footprints']


register_plugin("glint_elements", GlintElements)
