r"""
.. _bsdf-glint_particles:

Procedural glitter (:monosp:`glint_particles`)
----------------------------------------------

Glitter without a map, from a handful of flakes to more than anyone could count, at one cost.

.. pluginpictures::

.. pluginparameters::

 * - distribution
   - |string|
   - Distribution of the facets' normals, all together: :monosp:`ggx` or :monosp:`beckmann`.
     (Default: :monosp:`ggx`)

 * - alpha, or alpha_u and alpha_v
   - |float|
   - Roughness of the surface as it looks from afar, along both or each of the axes u and v, at
     least :monosp:`1e-4`. (Default: 0.3)
   - |exposed|, |differentiable|

 * - density
   - |float|
   - Decimal logarithm of the number of facets per unit of UV area, from -8 to 16; in object space,
     per unit of area there. (Default: 8)
   - |exposed|

 * - micro_alpha
   - |float|
   - Beckmann roughness of a single facet. At least 1e-6: a perfect mirror would show nothing of a
     small light but by chance. At most half of the least :monosp:`alpha`, as all facets together
     are rougher than each. (Default: 0.01, or this limit where it is less)
   - |exposed|, |differentiable|

 * - colors
   - |string| or :monosp:`mitsuba.Bitmap`
   - Colours of the facets: :monosp:`none`; :monosp:`wheel`, all hues, which together make white; or
     a palette, each pixel of an image being as likely as the others: the name of a file, relative
     to the scene's folder, or a bitmap. From afar the surface has the palette's mean colour.
     (Default: :monosp:`none`)

 * - color
   - |spectrum|
   - In place of :monosp:`colors`: the colour about which those of single facets vary, in [0, 1].

 * - hue_variation, saturation_variation, value_variation
   - |float|
   - Greatest differences of a facet's hue, in turns of the wheel from 0 to 0.5, and of its
     saturation and value, relative, from 0 to 1, from those of :monosp:`color`. (Default: 0)

 * - space
   - |string|
   - Where facets have their places. :monosp:`uv`: on the UV plane, and they stretch as UV
     coordinates do. :monosp:`object`: in space, where the surface cuts through them; the shape
     needs no UV coordinates. (Default: :monosp:`uv`)

 * - to_object
   - |transform|
   - For :monosp:`object`: from the world to the space of the facets. Mitsuba's meshes do not know
     how they were moved: to move one with its facets, give the inverse of its :monosp:`to_world`.
     (Default: none)
   - |exposed|

 * - seed
   - |int|
   - Another number gives other facets. (Default: 0)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. The axes of the roughness stay those
     of the surface. (Default: none)
   - |exposed|

 * - masking
   - |string|
   - Masking and shadowing of facets, that of all of them together: :monosp:`ggx`,
     :monosp:`beckmann` or :monosp:`none`. (Default: that of the distribution)

 * - height_correlated
   - |bool|
   - Whether masking and shadowing count a facet's height once. :monosp:`roughconductor` does not.
     (Default: false)

 * - footprint_sigma
   - |float|
   - Standard deviation of the footprint in pixels. (Default: 0.5)
   - |exposed|

 * Shared: pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

Glitter from a handful of facets to a million millions of them in a unit of UV, without a map, at
the same cost: nothing is stored, nothing is computed in advance, and an evaluation looks at 12
facets, seldom at 24. Each is a small lobe of roughness :monosp:`micro_alpha` with a place and a
normal of its own. All together they are the distribution of roughness :monosp:`alpha`, so that the
surface is :monosp:`roughconductor` from afar and on average.

The idea, a hierarchy of lattices in position and normal space whose every cell holds one hashed
facet, is that of Kemppinen et al. :cite:`Kemppinen2025Glints`. On the level that suits the
footprint,

.. math::

    D(m) = \beta \, \cos^{-4}\theta_m \sum_a 4^{-j} \sum_c b_c \, k(x - x_{ac})
         + (1 - \beta) \, D_\alpha(m)

with the slope :math:`x` of the half vector, :math:`4^j` cells :math:`a` of normals that have equal
shares of the distribution :math:`D_\alpha`, the vertices :math:`c` around the place, whose weights
:math:`b_c` add up to one, and a facet's lobe :math:`k`. So :math:`\int D = 1` under every
footprint, and sampling draws from exactly this density. Where a pixel covers so many facets that
their lobes overlap, :math:`\beta < 1` stands for their number: mean and variance of :math:`D` stay
those of facets that are strewn at random.

Place by place a facet may lean so far that it reflects more than it receives at grazing angles, as
any masking that knows nothing of the place lets it; on average it does not. The average is that of
``roughconductor`` within 0.1 % up to :monosp:`micro_alpha` of 0.2 alpha, 0.4 % up to 0.3 alpha, and
7 % at half of alpha. Footprints longer than 16 times their width count as wider.

Several kinds of facets, large and small or of two materials, are blended by ``blendbsdf``. The
material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap`` and ``mask`` as well.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_particles

        <bsdf type="glint_particles">
            <float name="alpha" value="0.4"/>
            <float name="density" value="6"/>
            <float name="micro_alpha" value="0.02"/>
            <rgb name="color" value="0.9, 0.3, 0.4"/>
            <float name="hue_variation" value="0.05"/>
            <float name="value_variation" value="0.5"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_particles',
            'alpha': 0.4,
            'density': 6.0,
            'micro_alpha': 0.02,
            'color': {'type': 'rgb', 'value': [0.9, 0.3, 0.4]},
            'hue_variation': 0.05,
            'value_variation': 0.5,
        })

Reference: Pauli Kemppinen, Loïs Paulin, Théo Thonat, Jean-Marc Thiery, Jaakko Lehtinen and Tamy
Boubekeur, "Evaluating and Sampling Glinty NDFs in Constant Time" (:cite:`Kemppinen2025Glints`).
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.bridge.surfaces import require_tangents, require_uvs, shapes_of
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.query import Place
from glintbsdf.pndf import Particles
from glintbsdf.pndf.colors import Palette, Wheel, varied
from glintbsdf.pndf.particles.particles import usual_micro_alpha

VARIATIONS = ("hue_variation", "saturation_variation", "value_variation")


class GlintParticles(GlintBSDF):
    """The plugin ``glint_particles``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        distribution = parameters.choice("distribution", "ggx", ("ggx", "beckmann"))
        self.masking_name = parameters.choice("masking", distribution, Particles.maskings)
        self.height_correlated = parameters.boolean("height_correlated", False)
        self.space = parameters.choice("space", "uv", ("uv", "object"))
        self.to_object = mi.ScalarAffineTransform4f()
        if self.space == "object":
            requirement = 'left out where "space" is object'
            check("to_uv" not in props, self.owner, "to_uv", requirement, "a transform")
            self.to_object = parameters.transform("to_object")
        alpha = parameters.per_axis("alpha", 0.3)
        self.options = {
            "alpha": alpha,
            "density": parameters.number("density", 8.0),
            "micro_alpha": parameters.number("micro_alpha", usual_micro_alpha(alpha)),
            "distribution": distribution,
            "colors": self.colors(parameters),
            "seed": parameters.whole("seed", 0),
            "owner": self.owner,
        }
        self.finish(Particles)

    @staticmethod
    def colors(parameters: Parameters) -> Wheel | Palette | None:
        """The colours of single facets."""
        parameters.only_one_of(("colors",), ("color", *VARIATIONS))
        if "color" in parameters.props:
            variations = [parameters.number(name, 0.0) for name in VARIATIONS]
            return varied(parameters.color("color"), *variations)
        colors = parameters.colors("colors", ("none", "wheel"))
        if isinstance(colors, str):
            return {"none": None, "wheel": Wheel()}[colors]
        return Palette(colors)

    def create(self, domain: Domain | None) -> Particles:
        return Particles(**self.options)

    def require_of_surfaces(self) -> None:
        if self.space == "uv":
            require_uvs(self.owner, shapes_of(self))
        else:
            require_tangents(self.owner, shapes_of(self))

    def place(self, si: mi.SurfaceInteraction3f) -> Place | None:
        if self.space == "uv":
            return None
        to_object = mi.AffineTransform4f(self.to_object)
        return Place(to_object @ mi.Point3f(si.p), to_object @ si.dp_du, to_object @ si.dp_dv)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        if self.space == "object":
            callback.put("to_object", self.to_object, mi.ParamFlags.NonDifferentiable)


register_plugin("glint_particles", GlintParticles)
