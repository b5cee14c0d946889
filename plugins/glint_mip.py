r"""
.. _bsdf-glint_mip:

Glints of a large map made from a small sample (:monosp:`glint_mip`)
--------------------------------------------------------------------

A large surface with glints, made from a small sample of its normals.

.. pluginpictures::

.. pluginparameters::

 * - filename
   - |string|
   - Image file of the sample, a normal or height map: OpenEXR, PNG, TIFF and what else Mitsuba
     reads. A relative name counts from the scene's folder.

 * - bitmap
   - :monosp:`mitsuba.Bitmap`
   - The sample itself, instead of :monosp:`filename`, when the scene is built in Python.

 * - data
   - |tensor|
   - The sample as a tensor of H×W×C values, C = 1…4, instead of :monosp:`filename`. What is exposed
     are its projected normals, H×W×2; new ones make everything anew.
   - |exposed|

 * Shared: layer, map_type, height_scale, encoding, flip_y, strength, fill_voids

 * - wrap_mode
   - |string|
   - What lies beyond the large map's border: with :monosp:`repeat` the map is made to fit to
     itself; :monosp:`mirror` mirrors it; :monosp:`clamp` does so too, and holds the centre of
     footprints inside. Heights in the sample are continued likewise. (Default: :monosp:`repeat`)

 * - to_uv
   - |transform|
   - Transform of the UV coordinates, as for a bitmap texture. The unit square is the large map, not
     the sample. (Default: none)
   - |exposed|

 * - output_size
   - |int|
   - Texels of the large map along each axis, more than a patch's. (Default: 4096)

 * - patch_size
   - |int|
   - Texels of a patch along each axis, fewer than the sample's. A patch must hold the features of
     the sample, such as a scratch; the larger it is, the fewer different ones there are.
     (Default: 64)

 * - overlap
   - |int|
   - Texels by which patches reach into each other, at least 1 and fewer than half a patch's. More
     of them make seams smoother; fewer leave more lobes to what is clustered at them. (Default: a
     tenth of :monosp:`patch_size`)

 * - balance
   - |float|
   - Weight α of normals against their Jacobians, in [0, 1], where patches are compared.
     (Default: 0.9)

 * - seed
   - |int|
   - Another number gives another map. (Default: 0)

 * - representation
   - |string|
   - What answers: :monosp:`lobes`, the MIP-mapped lobes of the paper; or :monosp:`exact`, the
     elements of :ref:`glint_elements <bsdf-glint_elements>` on the large map, and tables for large
     footprints, which takes :monosp:`wrap_mode` :monosp:`repeat`. (Default: :monosp:`lobes`)

 * - max_error
   - |float|
   - With :monosp:`exact`: relative L1 error of the P-NDF that tables may have, on average over the
     map; 0 for no tables. (Default: 0.05)

 * - clusters
   - |int|
   - With :monosp:`lobes`: lobes of each grid of every MIP level, from 1 to 1024: 16 for speed, 64
     for scratches. (Default: 32)

 * - normal_weight
   - |float|
   - With :monosp:`lobes`: weight of normals against positions where lobes are clustered: of
     standard deviations in the sample, against those in the grid. (Default: 8)

 * - lod_scale
   - |float|
   - With :monosp:`lobes`: factor :math:`C_P` of the MIP level :math:`\lambda = C_P \log_2 P` for a
     footprint that covers :math:`P` texels, two standard deviations by two. With 0.5, grids are as
     wide as the footprint; less is more accurate and slower. (Default: 0.5)

 * - sigma_r
   - |float|
   - Intrinsic roughness: the standard deviation of a projected normal, in [1e-8, 1]. Half vectors
     in single precision resolve a lobe down to 1e-7; normals are kept to 1.5e-5. (Default: 0.005)
   - |exposed|, |differentiable|

 * - masking
   - |string|
   - Masking and shadowing: :monosp:`footprint`, by the facets under the footprint, over the plane
     of their mean slope, so that no place reflects more light than it receives. All lobes are
     visited once more for it, which doubles the time of a query; with :monosp:`exact` it takes 34
     to 144 points of a footprint that is larger than a few texels. :monosp:`beckmann`: that of a
     level Beckmann surface as rough as the whole sample, with which a place that leans towards the
     viewer reflects more than it receives. Or :monosp:`none`. (Default: :monosp:`footprint`)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

A large microstructure that is never stored: it is put together from patches of a small sample, as
in :cite:`Tan2022`. Neighbouring patches are chosen to fit, and cut where they differ least; a
look-up table of some hundred kilobytes says which patch is seen where. What is seen under a
footprint are *lobes*, Gaussians in position × normal space: one for each texel of the sample, and
on every MIP level a fixed number for each grid of texels, to which those of the sample are
clustered, with their mass, mean and covariance. A footprint takes the lobes of the level whose
grids are about as wide as itself, so the cost does not depend on its size:

.. math::

    D(m) = \sum_{l \in \{\lfloor\lambda\rfloor, \lceil\lambda\rceil\}}
        \frac{t_l}{\sum_i w_i} \sum_{i \in l} w_i\,
        \mathcal{N}(m;\ s_i + J_i \mu_i,\ \sigma_r^2 I + R_i + J_i C_i J_i^T)

with :math:`t` the weights of linear interpolation between two levels, :math:`w_i` the mass of a
lobe under the footprint, and :math:`R_i` what its normals vary in one place. Sampling draws from
this density, within 1e-3, and it integrates to one.

Of a sample of 256×256 texels made 4096×4096, everything together takes 22 MB. Building it takes
some 14 seconds of processor time, once: the cache on disk keeps it. The map can be written out with
:monosp:`glintbsdf synthesise`, for other plugins or to look at. In smooth maps seams remain, since
two patches agree along their edges by chance only: in the overlaps, neighbouring texels of a map of
Gaussian bumps differ by 1.6 times as much (squared) as elsewhere, those of leather, flakes and
brushed metal by 1.1 to 1.3. What is longer than a patch, such as a scratch, is seen to be cut.

Where lobes are clustered, their details are lost: for footprints 16, 32, 64 and 128 texels wide the
P-NDF differs from that of :ref:`glint_elements <bsdf-glint_elements>` on the same map by 24, 16, 12
and 9 % (relative L1) on a map of Gaussian bumps, and by 7 to 10 % on one of scratches. At 64 texels
a query takes a seventh of the time that the elements take, at 16 and below two to four times as
long; where most of the surface reflects nothing, the elements are faster still.

*Lights.* :ref:`glint_path <integrator-glint_path>` lets the lobes integrate small lights: a lobe is
averaged over the ellipse of a light in closed form, and its Jacobian is relative to the half
vector, where that turns over the footprint. With :monosp:`representation` :monosp:`exact`, lights
are sampled.

*The map exactly.* Every texel of the large map is one of the sample's, seen through the patch that
owns it. With :monosp:`representation` :monosp:`exact`, footprints of a few texels sum the elements
of the large map's texels; larger ones walk inverted lists of the sample's elements, once for every
patch under them, and the texels on seams one by one. Both are the P-NDF of ``glint_elements`` on
the map that ``synthesise`` writes, to 1e-4, and so is the sampler. Where the footprint is so large
that its error is allowed, tables of blocks of the sample's texels serve, each with the share of it
that a patch owns; from some size on, one table of the whole map. Within a bin of these tables,
1/128 of the range of the sample's normals, D is constant. The error is measured when the tables are
built, at places all over the map: over a seam it is larger than the average, inside a patch it is
smaller. Lights are sampled, not integrated, in both representations.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_mip

        <bsdf type="glint_mip">
            <string name="filename" value="scratched.exr"/>
            <integer name="output_size" value="2048"/>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_mip',
            'filename': 'scratched.exr',
            'output_size': 2048,
            'material': 'Al',
        })

Reference: Haowen Tan, Junqiu Zhu, Yanning Xu, Xiangxu Meng, Lu Wang and Ling-Qi Yan, "Real-Time
Microstructure Rendering with MIP-mapped Normal Map Samples" (:cite:`Tan2022`), section 5.
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.footprint.domain import Domain
from glintbsdf.maps.normalmap import MapShape
from glintbsdf.pndf import PNDF, Mip, Patches

#: What answers, by the name of the representation.
REPRESENTATIONS: dict[str, type[PNDF]] = {"lobes": Mip, "exact": Patches}


class GlintMip(GlintBSDF):
    """The plugin ``glint_mip``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        sizes = {"output_size": 4096, "patch_size": 64, "seed": 0}
        self.normal_map = parameters.normal_map()
        self.options = {name: parameters.whole(name, x) for name, x in sizes.items()} | {
            "overlap": parameters.whole("overlap", None),
            "balance": parameters.number("balance", 0.9),
            "sigma_r": parameters.number("sigma_r", 0.005),
            "owner": self.owner,
        }
        self.kind = REPRESENTATIONS[parameters.choice("representation", "lobes", REPRESENTATIONS)]
        lobes = {
            "clusters": parameters.whole("clusters", 32),
            "lod_scale": parameters.number("lod_scale", 0.5),
            "normal_weight": parameters.number("normal_weight", 8.0),
        }
        max_error = parameters.number("max_error", 0.05)
        self.options |= lobes if self.kind is Mip else {"max_error": max_error}
        self.masking_name = parameters.choice("masking", Mip.maskings[0], Mip.maskings)
        self.finish(self.kind)

    def create(self, domain: Domain | None) -> PNDF:
        return self.kind(self.normal_map, **self.options)

    @property
    def map_shape(self) -> MapShape:
        size = self.options["output_size"]
        return MapShape(size, size, self.normal_map.wrap_mode)


register_plugin("glint_mip", GlintMip)
