r"""
.. _bsdf-glint_manifold:

Glints of a normal map, exact (:monosp:`glint_manifold`)
--------------------------------------------------------

A surface with the normals of a map, each of which glints exactly as the map has it.

.. pluginpictures::

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - kernel
   - |string|
   - Kernel that weights the points of the map under a footprint of standard deviation σ:
     :monosp:`gaussian`, cut at 3σ; :monosp:`disk`, uniform within 1.5σ; :monosp:`box`, uniform
     within ±1.5σ along u and v. (Default: :monosp:`gaussian`)

 * - epsilon
   - |float|
   - Smallest Jacobian determinant of a triangle of the manifold, in (0, 1). A flat part of the map
     becomes a highlight of about this area on the disk of projected normals. (Default: 1e-6)

 * - threshold
   - |float|
   - Threshold τ of the paper's hierarchy of clusters. A cluster replaces its triangles where the
     integral of its squared error, a distance in texels, is at most τ times the product
     :math:`r_x r_y` of the footprint's radii. Useful values are 1e-4 to 1e-2. With 0, evaluation is
     exact. (Default: 0)

 * - max_error
   - |float|
   - Largest relative L1 error of the P-NDF; a useful value is 0.05. Large footprints are then
     evaluated from tables of normals around the nodes of a lattice, at a cost that does not grow
     with the footprint. Small footprints are evaluated exactly. The error is that of the masses in
     the bins of the tables, which are 1/128 of the range of the map's normals wide, and at least
     1e-4. Within a bin D is constant, so finer or shifted bins have a larger error where many
     facets have almost the same normal, as in maps of flakes. The error is predicted from the
     footprint, and from errors that are measured on the map when the tables are built;
     the method ``measured_error`` of its ``pndf`` compares it with the true one. Each level of the
     tables takes up to 62 MiB; all levels, with the lists for small footprints, take up to 190 MiB.
     There is no blending: where a growing footprint changes to tables, or to the next level, D
     jumps by less than this error. Samples have exactly the density D. With :monosp:`wrap_mode`
     :monosp:`clamp`, and with 0, evaluation is exact at all sizes. It excludes :monosp:`threshold`.
     (Default: 0)

 * - hand_over
   - |float|
   - Size of the footprint (geometric mean of its standard deviations), in texels, from which on
     LEAN's smooth lobe replaces the P-NDF; 0 for never. From this size to twice the size, D is a
     mixture of both. Under the sun, a map of Gaussian bumps 6 texels wide differs from the lobe by
     8 % at 64 texels and 4 % at 128; maps of scratches or flakes still differ from a smooth lobe at
     256 texels (``python -m benchmarks accuracy hand_over``). At grazing angles, the lobe of a very
     steep map (slopes of 200) reflects more light than arrives. (Default: 0)

 * - masking
   - |string|
   - Masking and shadowing. :monosp:`ggx_fit` and :monosp:`analytic` use the projected area of the
     facets under the footprint, relative to the plane of their mean slope, so that no place
     reflects more light than it receives. :monosp:`ggx_fit` takes the projected area of a smooth
     surface with the same mean and covariance of slopes. :monosp:`analytic` sums over the
     triangles, which is exact but many times slower. :monosp:`beckmann` is the masking of a level
     Beckmann surface with the roughness of the whole map; a place that leans towards the viewer
     then reflects more than it receives. :monosp:`none`: no masking. (Default: :monosp:`ggx_fit`)

 * - height_correlated
   - |bool|
   - Whether masking and shadowing are correlated by height; otherwise they are independent.
     (Default: |true|)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

This BSDF renders the glints of a surface whose normals come from a high-resolution map. Every pixel
sees a part of the map, its *footprint*. The distribution of the normals in the footprint, the
P-NDF, replaces the smooth normal distribution of a microfacet BRDF. As in :cite:`Wu24Glint`, the
map is a mesh of triangles in position × normal space. On this mesh the P-NDF has a closed form,
which is evaluated exactly:

.. math::

    D(m) = \sum_{\Delta:\, m \in n(\Delta)} \frac{k(u^* - x)}{|\det J_\Delta|}

Here :math:`u^*` is the position in triangle :math:`\Delta` whose normal is :math:`m`, :math:`k` is
the kernel around the footprint's centre :math:`x`, and :math:`J_\Delta` is the Jacobian of the
normals over the triangle. Samples have exactly this density.

The paper masks facets relative to the geometric surface. But the facets under a footprint lean
together, and a plane does not hide itself. So here
:math:`1 + \Lambda(\omega) = \max(P(\omega)/\bar P(\omega), 1)`, where :math:`P` is the projected
area of the facets, and :math:`\bar P` the projected area of their mean plane. It also replaces the
cosine of the view in :math:`F D G / (4 \bar P(\omega_i))`, as in :cite:`Dupuy2013LEADR`. The other
plugins with a map do the same. ``python -m benchmarks energy`` compares the reflected energy with
ray tracing of the displaced surface. Both agree within 2 % up to an angle of 69°; near the horizon
the BSDF reflects less.

*Derivatives with respect to* :monosp:`data`. At a fixed :math:`m`, this density jumps whenever an
edge of a triangle moves across :math:`m`. Automatic differentiation would see the changes within
triangles, but not the jumps, and even the sign could be wrong. So while :monosp:`data` carry
derivatives (``dr.enable_grad``, then ``params.update()``), a mixture of elements as in
:ref:`glint_elements <bsdf-glint_elements>` replaces the manifold. Its elements are half a texel
apart, and its roughness is a tenth of the standard deviation of the map's normals, at least 0.001.
:monosp:`threshold` and :monosp:`max_error` then have no effect. Images are a little smoother, and
their derivatives are correct. Where ``glint_path`` integrates lights, elements of roughness 0.001
answer with derivatives and without, and images stay the same.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_manifold

        <bsdf type="glint_manifold">
            <string name="filename" value="scratched.exr"/>
            <transform name="to_uv">
                <scale x="4" y="4"/>
            </transform>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        bsdf = mi.load_dict({
            'type': 'glint_manifold',
            'filename': 'scratched.exr',
            'to_uv': mi.ScalarTransform4f().scale([4, 4, 1]),
            'material': 'Al',
        })

Reference: Liwen Wu, Fujun Luan, Miloš Hašan and Ravi Ramamoorthi, "Position-Normal Manifold for
Efficient Glint Rendering on High-Resolution Normal Maps" (:cite:`Wu24Glint`), section 4.
"""

from __future__ import annotations

import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.kernels import KERNELS
from glintbsdf.pndf import ClusteredManifold, HandOver, Manifold, TabulatedManifold
from glintbsdf.pndf.base import PNDF


class GlintManifold(GlintBSDF):
    """The plugin ``glint_manifold``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        parameters = Parameters(props)
        threshold, max_error = (parameters.number(name, 0.0) for name in ("threshold", "max_error"))
        check(
            not (threshold and max_error),
            self.owner,
            "threshold",
            'left out where "max_error" is given',
            threshold,
        )
        self.normal_map = parameters.normal_map()
        self.options = {
            "kernel": parameters.choice("kernel", "gaussian", KERNELS),
            "epsilon": parameters.number("epsilon", 1e-6),
            "owner": self.owner,
        }
        self.method: type[Manifold] = Manifold
        if threshold:
            self.method = ClusteredManifold
            self.options["threshold"] = threshold
        elif max_error:
            self.method = TabulatedManifold
            self.options["max_error"] = max_error
        self.masking_name = parameters.choice("masking", "ggx_fit", Manifold.maskings)
        self.height_correlated = parameters.boolean("height_correlated", True)
        self.hand_over = parameters.number("hand_over", 0.0)
        self.finish(self.method)

    def create(self, domain: Domain | None) -> PNDF:
        pndf = self.method(self.normal_map, domain=domain, **self.options)
        if self.hand_over and (domain is None or domain.largest > self.hand_over):
            return HandOver(pndf, self.hand_over, self.owner, domain)
        return pndf

    def remedies(self) -> list[str]:
        found = []
        if self.method is not TabulatedManifold:
            found.append('"max_error" 0.05 bounds the cost of wide footprints')
        if self.masking_name == "analytic":
            found.append('"masking" ggx_fit visits no triangle')
        return found

    def left_out(self) -> list[str]:
        features = {
            "clusters: threshold is 0": "threshold" in self.options,
            "tables: max_error is 0": "max_error" in self.options,
            "smooth lobe: hand_over is 0": self.hand_over,
        }
        return [name for name, value in features.items() if not value] + super().left_out()


register_plugin("glint_manifold", GlintManifold)
