r"""
.. _bsdf-glint_manifold:

Glints of a normal map, exact (:monosp:`glint_manifold`)
--------------------------------------------------------

.. pluginparameters::

 * Shared: filename, bitmap, data, layer, map_type, height_scale, encoding, flip_y, strength,
   fill_voids, wrap_mode, to_uv

 * - kernel
   - |string|
   - Weight of the map's points under the footprint with standard deviation σ: :monosp:`gaussian`,
     cut at 3σ; :monosp:`disk`, uniform within 1.5σ; :monosp:`box`, uniform within ±1.5σ along u and
     v. (Default: :monosp:`gaussian`)

 * - epsilon
   - |float|
   - Smallest Jacobian determinant of a triangle of the manifold, in (0, 1): a flat part of the map
     becomes a highlight of this area on the disk of projected normals. (Default: 1e-6)

 * - threshold
   - |float|
   - The threshold τ of the paper's hierarchy of clusters: a cluster of triangles takes the place of
     those of the map where the integral of its squared error, as a distance in texels, is at most
     τ times the footprint's radii :math:`r_x r_y`. Between 1e-4 and 1e-2, say; with 0, evaluation
     is exact. (Default: 0)

 * - max_error
   - |float|
   - Relative L1 error of the P-NDF allowed, over the bins of the tables, 1/128 of the range of the
     map's normals, at least 1e-4; 0.05, say. Within a bin normals are spread evenly: finer bins, or
     bins that lie otherwise, differ by more where many facets have nearly the same normal, as
     flakes have. Footprints large enough for it are evaluated from tables of the normals around the
     nodes of a lattice, whose distance grows with the footprint, at a cost that does not; small
     ones exactly. The error is predicted from the footprint and from errors measured on the map,
     for the kernel in use, when the tables are built. Over six kinds of maps and footprints from 11
     to 171 texels of standard deviation, the true one, averaged over three places, is 0.63 to 0.96
     of it (:monosp:`disk`: 0.56 to 0.95, :monosp:`box`: 0.45 to 0.91), and up to 1.2 at a single
     place. On a map of 1024², with 0.05, tables serve Gaussian footprints from 7 to 16 texels on,
     those of kernels with an edge later. Each level of the tables takes up to 62 MiB, all with the
     lists for small footprints up to 190 MiB. From exact to tabulated there is no transition but a
     change by less than this error. Sampling stays exact. With the :monosp:`wrap_mode`
     :monosp:`clamp`, and with 0, evaluation is exact at all sizes. Excludes :monosp:`threshold`.
     (Default: 0)

 * - hand_over
   - |float|
   - Size of the footprint (geometric mean of its standard deviations), in texels, from which the
     P-NDF gives way to LEAN's smooth lobe, which is all that is left at twice the size; 0 for
     never. Under the sun, a map of Gaussian bumps 6 texels wide differs from the lobe by 8 % at 64
     texels and 4 % at 128; maps of scratches or flakes differ from a smooth lobe still at 256. The
     lobe of a map as steep as slopes of 200 reflects more light than arrives at grazing angles.
     (Default: 0)

 * - masking
   - |string|
   - Masking and shadowing by the projected area of the facets under the footprint, over the plane
     of their mean slope, so that no place reflects more light than it receives: :monosp:`ggx_fit`,
     that of the smooth surface with the facets' mean and variance of slopes; :monosp:`analytic`,
     their own, exact but many times slower, as every triangle under the footprint counts. Or
     :monosp:`beckmann`, that of a level Beckmann surface as rough as the whole map, with which a
     place that leans towards the viewer reflects more than it receives, or :monosp:`none`.
     (Default: :monosp:`ggx_fit`)

 * - height_correlated
   - |bool|
   - Whether masking and shadowing are correlated by height, rather than independent.
     (Default: |true|)

 * Shared: footprint_sigma, pixel_spread, material, eta, k, int_ior, ext_ior, specular_reflectance

The glints of a surface whose normals come from a high-resolution map. Every pixel sees a patch of
the map, its *footprint*; the distribution of the normals in it, the P-NDF, takes the place of the
smooth normal distribution of a microfacet BRDF. As in :cite:`Wu24Glint`, the map is a mesh of
triangles in position × normal space, on which the P-NDF has a closed form, evaluated exactly:

.. math::

    D(m) = \sum_{\Delta:\, m \in n(\Delta)} \frac{k(u^* - x)}{|\det J_\Delta|}

where :math:`u^*` is the place in triangle :math:`\Delta` whose normal is :math:`m`, :math:`k` the
kernel around the footprint's centre :math:`x`, and :math:`J_\Delta` the Jacobian of the normals
over the triangle. Sampling draws from exactly this density.

The paper masks facets over the geometric surface. A footprint leans, though, and a plane hides
nothing of itself. Here :math:`1 + \Lambda(\omega) = \max(P(\omega)/\bar P(\omega), 1)`, with
:math:`P` the projected area of the facets and :math:`\bar P` that of their mean plane, which also
takes the place of the cosine of the view in :math:`F D G / (4 \bar P(\omega_i))`, as in
:cite:`Dupuy2013LEADR`. Other plugins with a map do the same. On a surface of slopes 0.15, at 0°,
46° and 69°, places under footprints of some texels reflect on average what a ray traced height
field does, within 2 %; at 83°, where it reflects 0.93, the rule gives 0.80 to 0.90.

*Derivatives with respect to* :monosp:`data`. This density, at a fixed :math:`m`, jumps whenever an
edge of a triangle moves across :math:`m`: automatic differentiation would see the change within
triangles, but not the jumps, and be wrong by a factor or by sign. As long as derivatives of
:monosp:`data` are asked for (``dr.enable_grad``, then ``params.update()``), the mixture of elements
of :ref:`glint_elements <bsdf-glint_elements>` therefore stands in, half a texel apart and with a
tenth of the roughness of the map's normals, at least 0.001, whatever :monosp:`threshold` and
:monosp:`max_error` say. Images are then smoother by this much, and their derivatives right: under a
smooth light 0.7 times as wide as the map's normals, within 1 % of the truth.

The material is one-sided and reflects only: use the ``twosided`` adapter for both sides. It works
inside ``normalmap``, ``bumpmap``, ``blendbsdf`` and ``mask`` as well. The shape needs UV
coordinates.

.. tabs::
    .. code-tab:: xml
        :name: lst-glint_manifold

        <bsdf type="glint_manifold">
            <string name="filename" value="scratches.exr"/>
            <transform name="to_uv">
                <scale x="4" y="4"/>
            </transform>
            <string name="material" value="Al"/>
        </bsdf>

    .. code-tab:: python

        'type': 'glint_manifold',
        'filename': 'scratches.exr',
        'to_uv': mi.ScalarTransform4f().scale([4, 4, 1]),
        'material': 'Al'

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
        self.finish()

    def create(self, domain: Domain | None) -> PNDF:
        pndf = self.method(self.normal_map, domain=domain, **self.options)
        if self.hand_over and (domain is None or domain.largest > self.hand_over):
            return HandOver(pndf, self.hand_over, self.owner, domain)
        return pndf

    def left_out(self) -> list[str]:
        features = {
            "clusters: threshold is 0": "threshold" in self.options,
            "tables: max_error is 0": "max_error" in self.options,
            "smooth lobe: hand_over is 0": self.hand_over,
        }
        return [name for name, value in features.items() if not value] + super().left_out()


register_plugin("glint_manifold", GlintManifold)
