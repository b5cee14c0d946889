r"""
.. _integrator-glint_path:

Path tracer with footprints (:monosp:`glint_path`)
--------------------------------------------------

Mitsuba's path tracer, in which glints know the size of a pixel at every bounce.

.. pluginpictures::

.. pluginparameters::

 * - max_depth
   - |int|
   - Longest path depth (where -1 corresponds to :math:`\infty`). A value of 1 renders directly
     visible light sources only, 2 adds single-bounce (direct) illumination, and so on.
     (Default: -1)

 * - rr_depth
   - |int|
   - Path depth from which *russian roulette* may end paths. (Default: 5)

 * - hide_emitters
   - |bool|
   - Hide directly visible emitters. (Default: no, i.e. |false|)

 * - separate
   - |bool|
   - Separate direct and indirect illumination, see below. (Default: no, i.e. |false|)

 * - pixel_share
   - |string| or |float|
   - Share of the pixel filter's variance that footprints carry, in [0, 1]; they are placed with the
     rest of the variance. 0 is sampling alone. (Default: :monosp:`auto`, which is 1 up to 16
     samples per pixel, and then falls slowly with their number; with a :monosp:`box` filter it
     falls from 4 samples on, and faster)

 * - light_share
   - |string| or |float|
   - Share of a small light's extent that P-NDFs integrate, in [0, 1]; the rest is sampled. 0 is
     sampling alone. (Default: :monosp:`auto`. It is 1 for spheres and disks up to 1024 samples per
     pixel, and then falls slowly with their number. For other shapes it falls from 16 samples on)

 * - emitters
   - |string|
   - The emitters to sample at a hit. :monosp:`all`: each of the 16 most powerful ones that are not
     environments, up to 16 bright regions of an environment, and one of the other emitters at
     random. :monosp:`one`: one of all emitters at random. (Default: :monosp:`all`)

This is Mitsuba's :monosp:`path` (BSDF and emitter sampling, combined by multiple
importance sampling), with one addition: the surface interaction that it hands to a BSDF carries
the UV partials ``duv_dx`` and ``duv_dy`` of the pixel, at *every* hit. Glint BSDFs average their
normals over this footprint. The stock integrators leave the partials at zero in Mitsuba's JIT
variants. A glint BSDF then has to use the cone of its ``pixel_spread`` parameter, which knows only
the distance to the last hit.

At the first hit the partials come from the sensor's ray differentials. At later hits they come from
a ray cone with an elliptical cross-section. It grows with distance. At each bounce it changes by
the curvature of the surface and the index of refraction :cite:`Igehy1999`, and the lobe that the
next direction was sampled from widens it. A direction of density :math:`p` stands for the solid
angle :math:`1/(p\,\mathrm{spp})` :cite:`Suykens2001`; smooth mirrors and glass do not widen the
cone. So a surface seen in a mirror is filtered as sharply as the mirror's image, and a surface seen
by a rough reflection is filtered as broadly as its lobe :cite:`AkenineMoller2021`. Sensors without
ray differentials start with a cone of width 0.

For scenes without glint BSDFs (or other BSDFs that read UV partials) the image is equal to that of
``path``, sample by sample. Participating media are ignored, and only JIT variants are supported.
Derivatives treat the partials as constants.

**Footprints and samples share the pixel's filter.** The value of a pixel is the image filtered by
the film's reconstruction filter, of variance Σ. Footprints filter as well, so they carry a share
:math:`a` of Σ. Samples are drawn from the filter, and each counts in one pixel only (filter
importance sampling :cite:`Ernst2006`). The footprint of a sample is contracted by
:math:`\sqrt{1 - a}` towards the pixel's centre, on the shape that the sample sees; so the edges of
shapes, and materials without footprints, have the whole filter.
Variances add. So with Mitsuba's default filter, a Gaussian, both together are exactly the filter,
whatever :math:`a` is; with other filters they have its mean and variance. Mitsuba scales ray
differentials by :math:`1/\sqrt{\mathrm{spp}}` instead. Footprints of this size cover the pixel only
by chance, and the error hardly falls with the number of samples. A footprint approximates the
surface as flat and its UV coordinates as affine. So :monosp:`auto` lets :math:`a` fall slowly with
the number of samples of the whole image, in however many passes it is rendered. The image is then
consistent.

This needs an :monosp:`hdrfilm`, and a filter with a positive variance, which :monosp:`catmullrom`
and :monosp:`lanczos` do not have. Otherwise, and inside other integrators such as :monosp:`aov`,
footprints are scaled by :math:`1/\sqrt{\mathrm{spp}}`. Derivatives of an image share the filter as
the image does.

**Small lights are sampled at every hit**, as the noise of a random choice would be large on glints.
One of the remaining emitters, environments among them, is chosen in proportion to its
``sampling_weight``. If only the environment remains, :ref:`glint_manifold <bsdf-glint_manifold>`,
:ref:`glint_elements <bsdf-glint_elements>` and the lobes of :ref:`glint_mip <bsdf-glint_mip>` look
for it by BSDF sampling alone, unless a diffuse lobe is beside them. Their P-NDF in a direction of
the environment costs as much as in a direction of their own, and mostly no glint is there.

**The P-NDF integrates small lights** in BSDFs that are able to do so, which are
:ref:`glint_elements <bsdf-glint_elements>`, :ref:`glint_manifold <bsdf-glint_manifold>`,
:ref:`glint_filtered <bsdf-glint_filtered>`, :ref:`glint_mip <bsdf-glint_mip>` with lobes,
:ref:`glint_grid <bsdf-glint_grid>` and :ref:`glint_particles <bsdf-glint_particles>`. A light is
small if it looks like a disk with a radius of at most 0.5 radians, or like another surface with
such a variance of directions. This variance is split as the pixel's filter is. A share becomes a
spread of half vectors, a uniform ellipse, over which the P-NDF is averaged. The rest is sampled, by
directions contracted towards the light's centre. A share of 1 leaves no noise except that of
shadows and textures of the light. But it rounds the corners of a rectangle, so for other shapes
than spheres and disks it falls sooner.
Visibility and radiance are taken at the sampled points, so shadows and textures keep their mean.
BSDF sampling then leaves these lights out, and nothing counts twice.

**The sun of an environment is a small light**, be it that of ``sunsky`` or of a map. The integrator
looks among samples of the environment for regions that are at least 16 times as bright as its mean,
and that make at least a sixteenth of its noise. It cuts them out as ellipses, and samples each at
every hit. BSDFs that integrate lights do not see the rest of the environment in these directions,
whether it is sampled by its emitter or by the BSDF. Radiance is always that of the environment.
A softbox is wider and dimmer. BSDF sampling finds it well, so it stays in the environment. Regions
are found anew for every image.

The half vector turns over a footprint, as the surface is curved, and as camera and light are near.
The integrator passes this turn to these BSDFs, whose P-NDF then sees the map as if its normals
turned in the opposite direction.

**Separated illumination.** Indirect light comes from everywhere, and its reflection by glints is
noise rather than a visible pattern. With :monosp:`separate` on, only *direct* light meets glints.
For *indirect* light, glint BSDFs use their smooth counterpart, the Beckmann lobe of the roughness
that all their glints have together :cite:`Tan2022`. This is the roughness of the whole map, or
:monosp:`alpha` of :monosp:`glint_grid`; :monosp:`glint_filtered` and :monosp:`glint_diffuse` are
smooth already. Behind a rough bounce footprints are wide, and glints cost most where nobody sees
them. Without them ``scenes/interreflection.xml``, in which :monosp:`max_error` bounds the cost of
wide footprints, takes 0.5 to 0.8 times as long (``python -m benchmarks separation``). Also, the
indirect image can be denoised without smoothing a glint away: ``glintbsdf render --denoise`` does
so.

Direct light reaches the first rough surface of a path along one straight segment. Mirrors, smooth
glass and openings of a mask do not count as surfaces here: the camera sees through them, so that
glints stay visible in mirrors. Emitters that the camera sees count as direct light, too. The image
has further channels, :monosp:`direct.R`, :monosp:`.G`, :monosp:`.B` and :monosp:`indirect.R`,
:monosp:`.G`, :monosp:`.B`, which add up to the whole. At its first rough surface, a path follows
two directions: one sampled from the glints, which looks for emitters only, and one sampled from the
smooth lobe. The expected indirect image differs from the one with :monosp:`separate` off, as the
smooth lobe differs from the glints. For BSDFs of your own, see ``glintbsdf.bridge.separation``.

.. tabs::
    .. code-tab:: xml
        :name: glint-path-integrator

        <integrator type="glint_path">
            <integer name="max_depth" value="8"/>
            <boolean name="separate" value="true"/>
        </integrator>

    .. code-tab:: python

        import glintbsdf
        import mitsuba as mi

        mi.set_variant('llvm_ad_rgb')
        integrator = mi.load_dict({
            'type': 'glint_path',
            'max_depth': 8,
            'separate': True,
        })

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from glintbsdf.bridge import filter_sampling
from glintbsdf.bridge.bsdf import prepare_for_lights
from glintbsdf.bridge.carried import (
    FINDS_ENVIRONMENT,
    HAS_FOOTPRINT,
    INTEGRATES_LIGHTS,
    Carried,
    half_vector_turn,
)
from glintbsdf.bridge.filter_sampling import SharedFilter
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.bridge.separation import smooth_context
from glintbsdf.footprint.pixel_filter import (
    LEAST_VARIANCE,
    PIXEL_SIGMA,
    PixelFilter,
    automatic_share,
)
from glintbsdf.footprint.raycone import RayCone, curved_interaction, lobe_width
from glintbsdf.lights import small
from glintbsdf.lights.small import SmallLights
from glintbsdf.lights.view import View


class GlintPathIntegrator(mi.SamplingIntegrator):
    """``path`` with a footprint at every hit; documentation in the module's docstring."""

    def __init__(self, props: mi.Properties) -> None:
        parameters = Parameters(props)
        parameters.refuse_unknown()
        parameters.boolean("hide_emitters", False)
        parameters.number("timeout", -1.0)
        for name in ("block_size", "samples_per_pass"):
            parameters.whole(name, None)
        super().__init__(props)  # uses these four
        self.separate = parameters.boolean("separate", False)
        max_depth = parameters.whole("max_depth", -1)
        self.max_depth = max_depth if max_depth >= 0 else 0xFFFFFFFF
        self.rr_depth = parameters.whole("rr_depth", 5)
        self.pixel_share = parameters.share("pixel_share")
        self.light_share = parameters.share("light_share")
        self.emitters = parameters.choice("emitters", "all", ("all", "one"))
        self.pixels_per_differential = self.shared = None

    # ------------------------------------------------------------------------------------------
    #  The pixel's filter
    # ------------------------------------------------------------------------------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render as every integrator of Mitsuba does, with samples drawn from the film's filter."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        film, sampler = sensor.film(), sensor.sampler().clone()
        if spp:
            sampler.set_sample_count(spp)
        with self.sharing(scene, film, sampler.sample_count()) as shared:
            if shared is None:
                return super().render(scene, sensor, seed, spp, develop, evaluate)
            filter_sampling.render(self, scene, sensor, shared, seed, spp)
            film.schedule_storage()
            image = film.develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(image)
            return image

    @contextmanager
    def sharing(
        self, scene: mi.Scene, film: mi.Film, samples: int
    ) -> Iterator[SharedFilter | None]:
        """A context in which footprints carry their share of the filter of ``film``, for an image
        with this number of ``samples`` per pixel.

        Yields how to place samples. Yields None if samples are not drawn from the filter: on films
        other than ``hdrfilm``, with filters whose variance is not positive, and, unless
        ``pixel_share`` is a number, in scenes without footprints.
        """
        pixel_filter = PixelFilter(film.rfilter())
        automatic = self.pixel_share == "auto"
        able = film.class_name() == "HDRFilm" and pixel_filter.variance > LEAST_VARIANCE
        if not able or (automatic and not has_footprints(scene)):
            yield None
            return
        share = self.pixel_share
        if automatic:
            share = automatic_share(samples, pixel_filter.abrupt)
        self.pixels_per_differential = (share * pixel_filter.variance) ** 0.5 / PIXEL_SIGMA
        self.shared = SharedFilter(pixel_filter, (1 - share) ** 0.5)
        try:
            yield self.shared
        finally:
            self.pixels_per_differential = self.shared = None

    def sized(self, ray: mi.RayDifferential3f, samples: int) -> mi.RayDifferential3f:
        """The sensor's ray, with differentials rescaled to the size of footprints. Mitsuba passes
        them scaled by 1/√samples."""
        if not ray.has_differentials or self.pixels_per_differential is None:
            return ray
        sized = mi.RayDifferential3f(mi.Ray3f(ray))
        sized.o_x, sized.o_y, sized.d_x, sized.d_y = ray.o_x, ray.o_y, ray.d_x, ray.d_y
        sized.has_differentials = True
        sized.scale_differential(dr.opaque(mi.Float, self.pixels_per_differential * samples**0.5))
        return sized

    def to_footprints(
        self,
        scene: mi.Scene,
        ray: mi.RayDifferential3f,
        pi: mi.PreliminaryIntersection3f,
        samples: int,
        active: mi.Bool,
    ) -> tuple[mi.RayDifferential3f, mi.PreliminaryIntersection3f]:
        """The rays through the centres of footprints, and what they hit, in place of the sensor's
        rays that hit a BSDF with a footprint. Where both do not hit the same shape, the sensor's
        own ray stays: what a pixel sees is decided by its samples, which lie as the filter says.

        Args:
            ray: the sensor's rays, whose differentials Mitsuba has scaled by 1/√``samples``.
            pi: what they hit.
        """
        if self.shared is None or self.shared.footprint_ray is None or not ray.has_differentials:
            return ray, pi
        moved = self.shared.footprint_ray
        scale = dr.opaque(mi.Float, samples**-0.5)
        wanted = active & pi.is_valid()
        wanted &= (pi.shape.bsdf().flags() & HAS_FOOTPRINT) != 0
        other = scene.ray_intersect_preliminary(mi.Ray3f(moved), coherent=True, active=wanted)
        same = wanted & other.is_valid() & (other.shape == pi.shape)
        same &= other.instance == pi.instance
        result = mi.RayDifferential3f(dr.select(same, mi.Ray3f(moved), mi.Ray3f(ray)))

        def step(of_footprint: mi.Vector3f, of_ray: mi.Vector3f) -> mi.Vector3f:
            return dr.select(same, scale * of_footprint, of_ray)

        result.o_x = result.o + step(moved.o_x - moved.o, ray.o_x - ray.o)
        result.o_y = result.o + step(moved.o_y - moved.o, ray.o_y - ray.o)
        result.d_x = result.d + step(moved.d_x - moved.d, ray.d_x - ray.d)
        result.d_y = result.d + step(moved.d_y - moved.d, ray.d_y - ray.d)
        result.has_differentials = True
        return result, dr.select(same, other, pi)

    def shares_of_lights(self, samples: int) -> tuple[float, float]:
        """The shares of a light's extent that the P-NDF integrates: of a light that looks like an
        ellipse, and of any other."""
        if self.light_share == "auto":
            return small.automatic_shares(samples)
        return self.light_share, self.light_share

    @dr.syntax
    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray_: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        """Radiance along the sensor's rays, whether the rays hit a surface, and the AOVs, which are
        direct and indirect light, or none."""
        if dr.hint(self.max_depth == 0, mode="scalar"):
            return mi.Spectrum(0), mi.Bool(False), [mi.Float(0) for _ in self.aov_names()]

        filters = has_footprints(scene)
        able = filters and any(flags & INTEGRATES_LIGHTS for flags in flags_of_bsdfs(scene))
        shares = self.shares_of_lights(sampler.sample_count()) if able else (0, 0)
        integrates = shares[0] > 0
        if integrates:
            prepare_for_lights()
        lights = SmallLights(scene, self.emitters == "all" and filters, integrates)
        light_shares = [dr.opaque(mi.Float, share) for share in shares] if integrates else None
        active = mi.Bool(active)
        pi = scene.ray_intersect_preliminary(mi.Ray3f(ray_), coherent=True, active=active)
        ray_, pi = self.to_footprints(scene, ray_, pi, sampler.sample_count(), active)
        ray_ = self.sized(ray_, sampler.sample_count())
        samples = dr.opaque(mi.Float, sampler.sample_count())

        # --------------------- Configure loop state ----------------------

        ray = mi.Ray3f(ray_)  # Current ray
        cone = RayCone.from_ray(ray_)  # Its width, for footprints
        L = mi.Spectrum(0)  # Radiance accumulator; of indirect light only if it is separate
        β = mi.Spectrum(1)  # Path throughput weight
        η = mi.Float(1)  # Index of refraction
        depth = mi.UInt32(0)  # Depth of current vertex
        bsdf_ctx = smooth_context() if self.separate else mi.BSDFContext()
        glint_ctx = mi.BSDFContext()

        # Separate illumination: direct light, and whether the path has met no rough surface so far
        L_direct = mi.Spectrum(0) if self.separate else None
        seen = mi.Bool(True) if self.separate else None

        # Variables caching information from the previous bounce
        si_prev = dr.zeros(mi.Interaction3f)
        bsdf_pdf_prev = mi.Float(1)
        bsdf_delta_prev = mi.Bool(True)
        integrated_prev = mi.Bool(False)  # Whether that BSDF integrates small lights,
        alone_prev = mi.Bool(False)  # and whether it alone looks for the environment

        # An environment is always visible, everything else once a path has hit it
        valid = mi.Bool(not self.hide_emitters and scene.environment() is not None)

        # ---------------------- Hide area emitters ----------------------

        if dr.hint(self.hide_emitters, mode="scalar"):
            # Continue rays that hit area emitters until they meet something else
            skip = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (per lane)
            si_skip = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, skip)
            pi[skip] = self.skip_area_emitters(scene, si_skip.spawn_ray(ray.d), True, skip)

        # As part of the loop's state, the sensor's ray would lose its flag has_differentials
        while dr.hint(
            active,
            max_iterations=self.max_depth,
            exclude=[ray_, lights, samples, light_shares],
            label="glint_path",
        ):
            # The curvature of the surface is what bends ray cones
            si = curved_interaction(pi, ray)

            # ---------------------- Direct emission ----------------------

            emitted = emission(
                lights, scene, si, si_prev, bsdf_pdf_prev, bsdf_delta_prev, integrated_prev,
                alone_prev,
            )  # fmt: skip
            if dr.hint(self.separate, mode="scalar"):
                L_direct[seen] = spectrum_fma(β, emitted, L_direct)
                L[~seen] = spectrum_fma(β, emitted, L)
            else:
                L = spectrum_fma(β, emitted, L)

            # Continue tracing the path at this point?
            active_next = (depth + 1 < self.max_depth) & si.is_valid()
            bsdf = si.bsdf()

            # ------------------------- Footprint -------------------------

            # The sensor's offset rays are intersected with the tangent plane (exact differences);
            # later hits have no offset rays, their partials come from the cone (first order).
            with dr.suspend_grad():
                cone = cone.at(si, ray.d)
                duv_dx, duv_dy = cone.uv_partials(si)
                si.compute_uv_partials(ray_)
                si.duv_dx = dr.select(depth == 0, si.duv_dx, duv_dx)
                si.duv_dy = dr.select(depth == 0, si.duv_dy, duv_dy)
                # A path that ends here reflects nothing, and a wide footprint would be costly
                si.duv_dx = dr.select(active_next, si.duv_dx, 0)
                si.duv_dy = dr.select(active_next, si.duv_dy, 0)
                curved = dr.detach(mi.SurfaceInteraction3f(si))
            # BSDFs get the curvature in another form, see Hit.seen_under
            si.dn_du, si.dn_dv = mi.Vector3f(0), mi.Vector3f(0)

            # ---------------------- Emitter sampling ----------------------

            active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            hit = Hit(scene, si, bsdf, lights)
            if dr.hint(light_shares is not None, mode="scalar"):
                hit.integrate_lights(curved, cone, light_shares)
            if dr.hint(self.separate, mode="scalar"):
                lit = direct_light(
                    hit, sampler, [(bsdf_ctx, active_em & ~seen), (glint_ctx, active_em & seen)]
                )
                L = spectrum_fma(β, lit[0], L)
                L_direct = spectrum_fma(β, lit[1], L_direct)
            else:
                lit = direct_light(hit, sampler, [(bsdf_ctx, active_em)])
                L = spectrum_fma(β, lit[0], L)

            # ---------------------- BSDF sampling ----------------------

            sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
            active_bs = active_next
            if dr.hint(light_shares is not None and not self.separate, mode="scalar"):
                # Skip the sample if the path ends at the next hit and cannot find a light there
                active_bs &= (depth + 2 < self.max_depth) | ~hit.finds_all_lights()
            bs, bsdf_weight = bsdf.sample(bsdf_ctx, si, sample_1, sample_2, active_bs)
            bsdf_weight = dr.select(active_bs, bsdf_weight, 0)
            ray_next, bsdf_weight = scatter(bsdf, bsdf_ctx, si, bs, bsdf_weight, active)

            # ----------- Glints in direct light (separate) -----------

            if dr.hint(self.separate, mode="scalar"):
                glints = active_next & seen
                bs_glint, weight = bsdf.sample(glint_ctx, si, sample_1, sample_2, glints)

                # Look for an emitter in the direction of a glint. Emitters behind mirrors, glass
                # and null interfaces are found by the path itself, which continues through them.
                glints &= mi.has_flag(bs_glint.sampled_type, mi.BSDFFlags.Smooth)
                ray_glint, weight = scatter(bsdf, glint_ctx, si, bs_glint, weight, glints)
                si_glint = scene.ray_intersect(ray_glint, glints)
                pdf = dr.select(glints, bs_glint.pdf, 0)
                emitted = emission(
                    lights, scene, si_glint, si, pdf, mi.Bool(False),
                    hit.integrates, hit.finds_environment,
                )  # fmt: skip
                L_direct[glints] = spectrum_fma(β, weight * emitted, L_direct)

                # A smooth lobe continues the path: emitters that it meets next are not counted
                seen_next = seen & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                bsdf_pdf_prev = dr.select(seen & ~seen_next, 0, bs.pdf)
                seen = seen_next
            else:
                bsdf_pdf_prev = bs.pdf

            # ------ Update loop variables based on current interaction ------

            β = β * bsdf_weight
            η *= bs.eta
            valid |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

            with dr.suspend_grad():
                # Mirrors, smooth glass and null interfaces have a discrete density, and no width
                smooth = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Smooth)
                spread = dr.select(smooth, lobe_width(bs.pdf, samples), 0)
                cone = cone.scattered(curved, ray.d, ray_next.d, bs.eta, spread)

            ray = ray_next

            # Information about the current vertex needed by the next iteration
            si_prev = mi.Interaction3f(si)
            bsdf_delta_prev = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            integrated_prev = hit.integrates & ~bsdf_delta_prev
            alone_prev = hit.finds_environment & ~bsdf_delta_prev

            # -------------------- Stopping criterion ---------------------

            depth[si.is_valid()] += 1

            # Russian roulette keeps path weights near one; η² undoes the solid-angle compression
            # at refractive boundaries. Its weight is detached, as the paths' number is fixed.
            β_max = dr.max(mi.unpolarized_spectrum(β))
            rr_prob = dr.detach(dr.minimum(β_max * dr.square(η), 0.95))
            rr_active = depth >= self.rr_depth
            rr_continue = sampler.next_1d() < rr_prob
            β[rr_active] *= dr.rcp(rr_prob)

            active = active_next & (~rr_active | rr_continue) & (β_max != 0)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, reorder=True, active=active)

        if dr.hint(self.separate, mode="scalar"):
            L_direct, L = dr.select(valid, L_direct, 0), dr.select(valid, L, 0)
            aovs = [*to_rgb(L_direct, ray_), *to_rgb(L, ray_)]
            return L_direct + L, valid, aovs
        return dr.select(valid, L, 0), valid, []

    def aov_names(self) -> list[str]:
        """``direct.R`` … ``indirect.B`` where illumination is separate."""
        parts = ("direct", "indirect") if self.separate else ()
        return [f"{part}.{channel}" for part in parts for channel in "RGB"]

    def to_string(self) -> str:
        max_depth = -1 if self.max_depth == 0xFFFFFFFF else self.max_depth
        return (
            f"GlintPathIntegrator[\n  max_depth = {max_depth},\n"
            f"  rr_depth = {self.rr_depth},\n  separate = {self.separate}\n]"
        )


def has_footprints(scene: mi.Scene) -> bool:
    """Whether any BSDF of the scene averages over a footprint."""
    return any(key.endswith("footprint_sigma") for key in mi.traverse(scene).keys())


def flags_of_bsdfs(scene: mi.Scene) -> list[int]:
    """The flags of all BSDFs of a scene, those inside of others included."""
    return [int(node.flags()) for node in mi.traverse(scene).hierarchy if isinstance(node, mi.BSDF)]


class Hit:
    """A surface interaction, and how its BSDF is evaluated for the scene's lights.

    Attributes:
        integrates (mi.Bool): whether the BSDF integrates a share of small lights.
    """

    def __init__(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        lights: SmallLights,
    ) -> None:
        self.scene, self.si, self.bsdf, self.lights = scene, si, bsdf, lights
        self.integrates, self.shares = mi.Bool(False), None

    def integrate_lights(
        self, curved: mi.SurfaceInteraction3f, cone: RayCone, shares: Sequence[mi.Float]
    ) -> None:
        """Let BSDFs that can do so integrate a share of small lights.

        Args:
            curved: the interaction with ``dn_du`` and ``dn_dv``, detached.
            cone: the ray cone at the interaction.
            shares: see :meth:`GlintPathIntegrator.shares_of_lights`.
        """
        self.curved, self.shares = curved, shares
        self.integrates = (self.bsdf.flags() & INTEGRATES_LIGHTS) != 0
        self.turned = cone.turned_per_uv(curved)

    @property
    def finds_environment(self) -> mi.Bool:
        """Whether BSDF sampling alone looks for the environment, whose bright regions are lights.
        It never does for a diffuse lobe."""
        if self.shares is None or not self.lights.others_are_environments:
            return mi.Bool(False)
        flags = self.bsdf.flags()
        return ((flags & FINDS_ENVIRONMENT) != 0) & ~mi.has_flag(flags, mi.BSDFFlags.Diffuse)

    def finds_all_lights(self) -> mi.Bool:
        """Whether emitter sampling finds all lights, so that BSDF sampling need not."""
        mirrors = mi.has_flag(self.bsdf.flags(), mi.BSDFFlags.Delta)
        return self.integrates & ~mirrors & self.lights.all_small(self.si.p)

    def seen_under(
        self, ds: mi.DirectionSample3f, view: View | None, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Vector3f, mi.Bool]:
        """For a sample of a light: the interaction, with the turn of the half vector and the
        spread of the light in it; the direction to evaluate the BSDF for (world space); and whether
        the BSDF integrates the light.

        ``view``: of the light; None for that of the emitter."""
        if self.shares is None:
            return self.si, ds.d, mi.Bool(False)
        with dr.suspend_grad():
            si = self.curved
            if view is None:
                view = self.lights.view(ds.emitter, si.p, active & self.integrates)
            share = dr.select(view.elliptic, *self.shares)
            variance = dr.select(self.integrates, view.spread(share), 0)
            d = view.contracted(dr.detach(ds.d), variance)
            far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            inverse_distance = dr.select(far, 0, dr.rcp(ds.dist))
            turn = half_vector_turn(si, d, *self.turned, inverse_distance)
            # For a light that BSDF sampling finds, too, the BSDF must have the same value: no turn.
            small = self.integrates & view.small
            turn = (dr.select(small | ds.delta, w, 0) for w in turn)
            carrier = Carried(*turn, variance).put(si)
        si = mi.SurfaceInteraction3f(self.si)
        si.dn_du, si.dn_dv = carrier.dn_du, carrier.dn_dv
        return si, dr.select(variance > 0, d, ds.d), small


def direct_light(
    hit: Hit, sampler: mi.Sampler, lobes: list[tuple[mi.BSDFContext, mi.Bool]]
) -> list[mi.Spectrum]:
    """Light that comes straight from emitters and is reflected by the BSDF.

    It comes from all lights that are sampled at every hit, and from one of the other emitters.
    ``lobes`` are pairs of a context and of the lanes in which it is needed; there is a result for
    each.
    """
    lights = hit.lights
    active = lobes[0][1]
    for _, wanted in lobes[1:]:
        active = active | wanted

    L = light_of_sampled(hit, sampler, lobes, active)
    active = active & ~hit.finds_environment
    if lights.sampled_count == 0:
        ds, weight = hit.scene.sample_emitter_direction(hit.si, sampler.next_2d(), False, active)
    elif lights.others_count > 0:
        emitter, probability, random = lights.choose(sampler.next_2d(), active)
        ds, weight = emitter.sample_direction(hit.si, random, active)
        ds.emitter = emitter
        ds.pdf *= probability
        weight = weight * dr.rcp(probability)
    else:
        return L
    weight = dr.select(lights.in_region(ds, active & hit.integrates), 0, weight)
    of_other = reflected(hit, lobes, ds, weight)
    return [a + b for a, b in zip(L, of_other, strict=True)]


def light_of_sampled(
    hit: Hit,
    sampler: mi.Sampler,
    lobes: list[tuple[mi.BSDFContext, mi.Bool]],
    active: mi.Bool,
) -> list[mi.Spectrum]:
    """The part of :func:`direct_light` from lights that are sampled at every hit: emitters, and, if
    the BSDF integrates lights, bright regions of the environment."""
    lights = hit.lights
    L = [mi.Spectrum(0) for _ in lobes]
    if lights.sampled_count == 0 and lights.regions is None:
        return L
    end = lights.count_sampled(hit.integrates)

    def add(k, sampler, L):
        ds, weight, view = lights.sample_direction(k, hit.si, sampler.next_2d(), active)
        of_light = reflected(hit, lobes, ds, weight, view)
        return k + 1, sampler, [a + b for a, b in zip(L, of_light, strict=True)]

    return dr.while_loop(
        (mi.UInt32(0), sampler, L),
        lambda k, sampler, L: active & (k < end),
        add,
        max_iterations=-1,
        label="emitters",
    )[2]


def reflected(
    hit: Hit,
    lobes: list[tuple[mi.BSDFContext, mi.Bool]],
    ds: mi.DirectionSample3f,
    weight: mi.Spectrum,
    view: View | None = None,
) -> list[mi.Spectrum]:
    """Light of one sample ``ds`` of an emitter that each lobe reflects. It is weighted for multiple
    importance sampling with the BSDF, and 0 where the emitter is hidden.

    ``view``: how the light looks; None to look at the emitter.
    """
    sampled = ds.pdf != 0

    # Recompute the contribution with AD to enable light source optimization. Where an environment
    # has regions, it is left as it is: it looks the same from everywhere.
    if dr.grad_enabled(hit.si.p):
        ds.d = dr.normalize(ds.p - hit.si.p)
        value = hit.scene.eval_emitter_direction(hit.si, ds, sampled)
        value = dr.select(sampled, value / ds.pdf, 0)
        weight = dr.select(hit.lights.is_cut(ds.emitter), weight, value)

    si, d, integrated = hit.seen_under(ds, view, sampled)
    wo = si.to_local(d)
    values, lit, needed = [], mi.Bool(False), []
    for ctx, active in lobes:
        active = active & sampled
        value, pdf = hit.bsdf.eval_pdf(ctx, si, wo, active)
        value = si.to_world_mueller(value, -wo, si.wi)
        alone = ds.delta | integrated
        value = value * weight * dr.select(alone, 1, mis_weight(ds.pdf, pdf))
        if not dr.grad_enabled(value):
            # Most points of a map reflect nothing of a light, and need no shadow ray.
            active = active & (dr.max(mi.unpolarized_spectrum(value)) != 0)
        values.append(value)
        needed.append(active)
        lit = lit | active
    hidden = hit.scene.ray_test(dr.detach(hit.si.spawn_ray_to(ds.p)), lit)
    return [
        dr.select(active & ~hidden, value, 0) for active, value in zip(needed, values, strict=True)
    ]


def emission(
    lights: SmallLights,
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    si_prev: mi.Interaction3f,
    pdf_prev: mi.Float,
    delta_prev: mi.Bool,
    integrated_prev: mi.Bool,
    alone_prev: mi.Bool,
) -> mi.Spectrum:
    """Emission to ``si_prev`` of the emitter at ``si``, if there is one.

    A BSDF sample of density ``pdf_prev`` has found it. It is weighted for multiple importance
    sampling with emitters, except for the environment where the BSDF alone looks for it,
    ``alone_prev``. It is 0 where the density is 0, or where the BSDF has already integrated this
    emitter.
    """
    ds = mi.DirectionSample3f(scene, si, si_prev)
    if lights.extents:
        counted = integrated_prev & lights.view(ds.emitter, si_prev.p).small
        counted |= lights.in_region(ds, integrated_prev & (pdf_prev > 0))
        pdf_prev = dr.select(counted, 0, pdf_prev)
    alone = alone_prev & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    em_pdf = dr.select(alone, 0, lights.pdf_direction(scene, si_prev, ds, ~delta_prev & ~alone))
    return ds.emitter.eval(si, pdf_prev > 0) * mis_weight(pdf_prev, em_pdf)


def scatter(
    bsdf: mi.BSDFPtr,
    ctx: mi.BSDFContext,
    si: mi.SurfaceInteraction3f,
    bs: mi.BSDFSample3f,
    weight: mi.Spectrum,
    active: mi.Bool,
) -> tuple[mi.Ray3f, mi.Spectrum]:
    """The ray in the direction that was sampled, and the sample's weight in world space.

    Samples must not move with the parameters that the image is differentiated by. So the direction
    is detached, and only the BSDF's value carries derivatives.
    """
    weight = si.to_world_mueller(weight, -bs.wo, si.wi)
    ray = si.spawn_ray(si.to_world(bs.wo))
    if dr.grad_enabled(ray):
        ray = dr.detach(ray)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ray.d), active)
        weight[pdf > 0] = value / dr.detach(pdf)
    return ray, weight


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic (Veach 1997) for a sample of ``pdf_a``; 0 if undefined."""
    pdf_a, pdf_b = dr.square(pdf_a), dr.square(pdf_b)
    weight = pdf_a / (pdf_a + pdf_b)
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0))


def to_rgb(spectrum: mi.Spectrum, ray: mi.Ray3f) -> list[mi.Float]:
    """Red, green and blue of a sensor's ray, as Mitsuba's ``aov`` integrator takes them: the
    sensor is assumed to have drawn the wavelengths by ``sample_rgb_spectrum``."""
    spectrum = mi.unpolarized_spectrum(spectrum)
    if mi.is_spectral:
        pdf = mi.pdf_rgb_spectrum(ray.wavelengths)
        spectrum = mi.spectrum_to_srgb(
            spectrum * dr.select(pdf > 0, dr.rcp(pdf), 0), ray.wavelengths
        )
    return [spectrum[0]] * 3 if mi.is_monochromatic else list(spectrum)


def spectrum_fma(a: mi.Spectrum, b: mi.Spectrum, c: mi.Spectrum) -> mi.Spectrum:
    """``a b + c``, with one rounding; in polarised variants a product of Mueller matrices."""
    return a * b + c if mi.is_polarized else dr.fma(a, b, c)


register_plugin("glint_path", GlintPathIntegrator)
