"""Features that are switched off cost nothing: tests count operations of kernels, not time.

A kernel is recorded for one call of a BSDF, with inputs that Dr.Jit does not know. The counts are
the same in every run and on every machine, so tests can require equal kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.bridge.separation import smooth_context
from glintbsdf.footprint.domain import Recorder
from glintbsdf.pndf import Elements, Filtered, Manifold

LANES = 16
MAP = maps.isotropic(32, seed=1)


@pytest.fixture(autouse=True)
def _history(variant) -> Iterator[None]:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        yield
    dr.kernel_history_clear()


def operations(record: Callable[[], object]) -> int:
    """Operations of the largest kernel that computes the result of ``record``."""
    result = record()
    dr.kernel_history_clear()
    dr.eval(result)
    return max(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))


def interaction(partials: bool = True) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.uv = mi.Point2f(dr.linspace(mi.Float, 0.2, 0.8, LANES), 0.3)
    si.t = 1
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.n = si.sh_frame.n = mi.Normal3f(0, 0, 1)
    si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = dr.normalize(mi.Vector3f(0.2, 0.1, 1))
    si.duv_dx, si.duv_dy = mi.Vector2f(0.01, 0), mi.Vector2f(0, 0.01)
    dr.make_opaque(si)
    # These integrators pass neither a turn of the half vector nor a light's spread.
    si.dn_du, si.dn_dv = mi.Vector3f(0), mi.Vector3f(0)
    if not partials:  # as in Mitsuba's integrators
        si.duv_dx, si.duv_dy = mi.Vector2f(0), mi.Vector2f(0)
    return si


def outgoing() -> mi.Vector3f:
    wo = dr.normalize(mi.Vector3f(dr.linspace(mi.Float, -0.2, 0.2, LANES), 0, 1))
    dr.make_opaque(wo)
    return wo


def make(plugin: str, **parameters) -> mi.BSDF:
    if plugin not in ("glint_grid", "glint_particles"):
        parameters["data"] = mi.TensorXf(MAP.normals)
    return mi.load_dict({"type": plugin, **parameters})


def evaluation(bsdf: mi.BSDF, ctx: mi.BSDFContext | None = None, **options) -> int:
    si, wo = interaction(**options), outgoing()
    return operations(lambda: bsdf.eval_pdf(ctx or mi.BSDFContext(), si, wo))


def sampling(bsdf: mi.BSDF) -> int:
    si = interaction()
    sample = mi.Point3f(0.3, 0.4, 0.6)
    dr.make_opaque(sample)
    return operations(
        lambda: bsdf.sample(mi.BSDFContext(), si, sample.x, mi.Point2f(sample.y, sample.z))
    )


#: Plugin, minimal parameters, parameters that switch features off explicitly, and each feature on.
FEATURES = [
    (
        "glint_manifold",
        {"masking": "none"},
        {"max_error": 0.0, "threshold": 0.0, "hand_over": 0.0, "pixel_spread": 0.0},
        {
            "max_error": 0.2,
            "threshold": 1e-2,
            "hand_over": 8.0,
            "masking": "beckmann",
            "material": "Au",
            "int_ior": 1.5,
            "specular_reflectance": 0.5,
            "pixel_spread": 1e-3,
            "to_uv": 2.0,
        },
    ),
    (
        "glint_filtered",
        {"masking": "none"},
        {"pixel_spread": 0.0, "method": "lean"},
        {"masking": "smith", "material": "Au", "specular_reflectance": 0.5, "pixel_spread": 1e-3},
    ),
    (
        "glint_elements",
        {"masking": "none"},
        {"pixel_spread": 0.0},
        {"masking": "beckmann", "material": "Au", "specular_reflectance": 0.5},
    ),
    (
        "glint_grid",
        {},
        {"colors": "none", "light_spread": 0.0, "pixel_spread": 0.0},
        {"colors": "wheel", "material": "Au", "specular_reflectance": 0.5, "pixel_spread": 1e-3},
    ),
    (
        "glint_particles",
        {"masking": "none"},
        {"colors": "none", "space": "uv", "pixel_spread": 0.0},
        {
            "colors": "wheel",
            "space": "object",
            "masking": "ggx",
            "material": "Au",
            "specular_reflectance": 0.5,
            "pixel_spread": 1e-3,
        },
    ),
    (
        "glint_diffuse",
        {},
        {"pixel_spread": 0.0, "method": "manifold"},
        {"pixel_spread": 1e-3},
    ),
]


@pytest.mark.parametrize(("plugin", "base", "off", "on"), FEATURES, ids=lambda x: x)
def test_a_feature_that_is_off_is_not_in_the_kernel(plugin, base, off, on):
    left_out = evaluation(make(plugin, **base))
    assert evaluation(make(plugin, **base, **off)) == left_out
    for feature, value in on.items():
        if feature == "to_uv":
            value = mi.ScalarTransform4f().scale(value)
        assert evaluation(make(plugin, **{**base, feature: value})) > left_out, feature


@pytest.mark.parametrize("plugin", ["glint_manifold", "glint_filtered", "glint_grid"])
def test_a_feature_that_is_off_is_not_in_the_kernel_that_samples(plugin):
    off = {} if plugin == "glint_grid" else {"masking": "none"}
    left_out = sampling(make(plugin, **off))
    for feature in ({"material": "Au"}, {"specular_reflectance": 0.5}):
        assert sampling(make(plugin, **off, **feature)) > left_out


@pytest.mark.parametrize("plugin", ["glint_manifold", "glint_elements"])
def test_a_perfect_mirror_without_masking_is_the_p_ndf_alone(plugin):
    """A BSDF adds a half vector, its Jacobian and the tests of the hemisphere."""
    normal_map = NormalMap(MAP.normals)
    pndf = Manifold(normal_map) if plugin == "glint_manifold" else Elements(normal_map, 0.005)
    si = interaction()
    m = mi.Vector2f(dr.linspace(mi.Float, -0.1, 0.1, LANES), 0)
    dr.make_opaque(m)
    footprint = Footprint(si.uv, si.duv_dx, si.duv_dy)
    alone = operations(lambda: pndf.eval(m, footprint))
    # Measured: 72.
    assert alone < evaluation(make(plugin, masking="none")) < alone + 90


def test_simpler_kernels_are_shorter():
    gaussian, disk, box = (
        evaluation(make("glint_manifold", masking="none", kernel=kernel))
        for kernel in ("gaussian", "disk", "box")
    )
    assert box < disk < gaussian


def test_filters_look_up_only_the_moments_they_need():
    footprint = interaction()
    footprint = Footprint(footprint.uv, footprint.duv_dx, footprint.duv_dy)
    counts = {
        method: operations(lambda method=method: Filtered(MAP, method).pyramid.average(footprint))
        for method in ("toksvig", "clean", "variance", "lean")
    }
    # Two words hold CLEAN's three moments, three words those of the others. LEAN alone has a
    # covariance, whose root is triangular. Variance mapping does not use the variance between
    # lookups.
    assert counts["clean"] < counts["variance"] < counts["lean"]
    assert counts["clean"] < counts["toksvig"] < counts["lean"]


def test_no_footprint_no_code_for_its_extent():
    """Mitsuba's own integrators without pixel_spread give a point."""
    bsdf = make("glint_manifold", masking="none")
    assert evaluation(bsdf, partials=False) < evaluation(bsdf)


def test_recorder_is_off_by_default():
    bsdf = make("glint_manifold", masking="none")
    alone = evaluation(bsdf)
    bsdf.watch = Recorder(bsdf.normal_map)
    assert evaluation(bsdf) > alone


def test_smooth_lobes_have_no_code_of_glints():
    bsdf = make("glint_manifold")
    assert evaluation(bsdf, smooth_context()) < 0.25 * evaluation(bsdf)


def test_separate_illumination_costs_nothing_where_it_is_off():
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "film": {"type": "hdrfilm", "width": 4, "height": 4},
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
        },
        "shape": {"type": "rectangle", "bsdf": {"type": "glint_grid"}},
        "light": {"type": "constant"},
    }

    def rendering(**options) -> int:
        integrator = {"type": "glint_path", "max_depth": 3, **options}
        loaded = mi.load_dict({**scene, "integrator": integrator})
        dr.kernel_history_clear()
        dr.eval(mi.render(loaded, spp=1))
        return max(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))

    assert rendering(separate=False) == rendering() < rendering(separate=True)
