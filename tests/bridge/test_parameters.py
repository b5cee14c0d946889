"""Conversion of parameters from Mitsuba's properties. For errors see ``suite.py``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import ParameterError
from glintbsdf.bridge.parameters import OTHER_NAMES, PARAMETERS, Parameters
from glintbsdf.microfacet.interface import Conductor, Dielectric, Mirror


def parameters(**values) -> Parameters:
    props = mi.Properties("glint_test")
    for name, value in values.items():
        props[name] = value
    return Parameters(props)


def test_numbers(variant):
    given = parameters(a=2, b=0.5, c=np.float32(3))
    assert [given.number(name, 7.0) for name in "abcd"] == [2.0, 0.5, 3.0, 7.0]
    message = r'glint_test: "a" must be a finite number from 0 to 1000000 \(got -2\)'
    with pytest.raises(ParameterError, match=message):
        parameters(a=-2).number("a", 1.0)


def test_choices_and_booleans(variant):
    assert parameters(a="x").choice("a", "y", ("x", "y")) == "x"
    assert parameters().choice("a", "y", ("x", "y")) == "y"
    assert parameters(a=False).boolean("a", True) is False
    for value in (1, "true"):
        with pytest.raises(ParameterError, match="must be true or false"):
            parameters(a=value).boolean("a", True)


def test_parameters_that_exclude_each_other_are_named(variant):
    def message(action) -> str:
        with pytest.raises(ParameterError) as caught:
            action()
        return str(caught.value)

    given = parameters(filename="a.exr", flake_density=9.0)
    assert message(lambda: given.only_one_of(("filename", "data"), ("flake_density",))) == (
        'glint_test: "filename" and "flake_density" exclude each other '
        "(got filename, flake_density)"
    )
    given = parameters(alpha=0.1, alpha_u=0.1, alpha_v=0.2)
    assert message(lambda: given.per_axis("alpha", 0.3)) == (
        'glint_test: "alpha" and "alpha_u" exclude each other (got alpha, alpha_u, alpha_v)'
    )


def test_error_about_a_missing_map_names_alternatives(variant):
    begin = r'glint_test: one of "filename", "bitmap" or "data" must give the normal or height map'
    with pytest.raises(ParameterError, match=begin + r" \(got none of them\)"):
        parameters().normal_map()
    with pytest.raises(ParameterError, match=begin + r', or "flakes" take its place \(got none'):
        parameters().normal_map(instead="flakes")


def test_reading_marks_a_property_as_known(variant):
    given = parameters(a=1.0, b=2.0)
    given.number("a", 0.0)
    assert given.props.unqueried() == ["b"]


def test_to_uv(variant):
    assert parameters().to_uv() == mi.ScalarAffineTransform3f()
    four = mi.ScalarTransform4f().translate([0.1, 0.2, 0.3]).scale([2, 3, 4])
    three = mi.ScalarTransform3f().translate([0.1, 0.2]).scale([2, 3])
    for transform in (four, three):
        matrix = np.array(parameters(to_uv=transform).to_uv().matrix)
        assert np.allclose(matrix, [[2, 0, 0.1], [0, 3, 0.2], [0, 0, 1]])
    for transform in (
        mi.ScalarTransform4f().scale([1, 0, 1]),
        mi.ScalarTransform4f().translate([float("nan"), 0, 0]),
        mi.ScalarTransform4f().scale([1, 1e8, 1]),
    ):
        with pytest.raises(ParameterError, match='"to_uv" must be a finite, invertible'):
            parameters(to_uv=transform).to_uv()


@pytest.mark.openexr
def test_map_from_a_relative_file_name(variant, tmp_path, monkeypatch):
    mi.Bitmap(np.full((4, 6, 2), 0.1, np.float32)).write(str(tmp_path / "map.exr"))
    resolver = mi.FileResolver(mi.file_resolver())
    resolver.append(str(tmp_path))
    monkeypatch.setattr("glintbsdf.bridge.parameters.mi.file_resolver", lambda: resolver)
    normal_map = parameters(filename="map.exr", wrap_mode="clamp").normal_map()
    assert (normal_map.height, normal_map.width, normal_map.wrap_mode) == (4, 6, "clamp")


def test_tensors_of_any_type(variant):
    values = np.random.default_rng(0).random((3, 5, 1))
    expected = parameters(data=mi.TensorXf(values)).normal_map().normals
    for tensor in (mi.TensorXd, mi.TensorXf16):
        normals = parameters(data=tensor(values)).normal_map().normals
        assert np.allclose(normals, expected, atol=1e-3)


def test_material(variant):
    assert isinstance(parameters().interface(), Mirror)
    assert isinstance(parameters(material="none").interface(), Mirror)
    for preset in ("Au", "Al", "Cu"):
        conductor = parameters(material=preset).interface()
        expected = mi.traverse(mi.load_dict({"type": "conductor", "material": preset}))
        si = dr.zeros(mi.SurfaceInteraction3f)
        assert dr.allclose(conductor.eta.eval(si), expected["eta.value"])
        assert dr.allclose(conductor.k.eval(si), expected["k.value"])
    with pytest.raises(ParameterError, match='"material" must be one of none, Ag, Al, .*got "Fe2"'):
        parameters(material="Fe2").interface()


def test_indices_of_refraction(variant):
    def eta(**values) -> float:
        return parameters(**values).interface().eta[0]

    assert eta(int_ior=1.5, ext_ior=1.2) == pytest.approx(1.25)
    assert eta(int_ior=2, ext_ior=1) == 2
    assert eta(int_ior="bk7", ext_ior="vacuum") == pytest.approx(1.5046)
    assert eta(int_ior=1.5) == pytest.approx(1.5 / 1.000277)
    assert eta(ext_ior="water") == pytest.approx(1.5046 / 1.333)
    with pytest.raises(
        ParameterError,
        match='"int_ior" must be a finite number from 0.001 to 1000 or one of vacuum, .*',
    ):
        parameters(int_ior="bk8").interface()


def test_eta_and_k_of_every_kind(variant):
    si = dr.zeros(mi.SurfaceInteraction3f)
    conductor = parameters(eta=mi.ScalarColor3d(0.2, 1.5, 3.0), k=2).interface()
    assert isinstance(conductor, Conductor)
    assert dr.allclose(conductor.eta.eval(si), [0.2, 1.5, 3.0])
    assert dr.allclose(conductor.k.eval(si), 2)
    texture = mi.load_dict(
        {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 1), 4, np.float32))}
    )
    assert dr.allclose(parameters(eta=texture).interface().eta.eval(si), 4)
    assert dr.allclose(parameters(eta=1.0).interface().k.eval(si), 1)  # as roughconductor
    assert dr.allclose(parameters(k=1.0).interface().eta.eval(si), 0)


def test_spectra(each_variant):
    si = dr.zeros(mi.SurfaceInteraction3f)
    if mi.is_spectral:
        si.wavelengths = 550
    given = mi.load_dict(
        {
            "type": "glint_manifold",
            "data": mi.TensorXf(np.zeros((2, 2, 2))),
            "eta": {"type": "spectrum", "value": [(400, 1.0), (700, 2.0)]},
            "k": 0,
            "specular_reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]},
        }
    )
    assert np.allclose(np.array(given.specular_reflectance.eval(si)), 0.5, atol=1e-3)
    if mi.is_spectral:
        assert np.allclose(np.array(given.interface.eta.eval(si)), 1.5)
    assert isinstance(Parameters(mi.Properties("glint_test")).interface(), Mirror)
    assert isinstance(parameters(int_ior=1.5).interface(), Dielectric)


@pytest.mark.parametrize(
    ("plugin", "name", "ours"),
    [
        ("glint_elements", "flake_roughness", "sigma_r"),
        ("glint_elements", "Flake_Orientation", "flake_alpha"),
        ("glint_grid", "flake_roughness", "detail_alpha"),
        ("glint_grid", "glitter_density", "density"),
        ("glint_filtered", "roughness", "alpha"),
        ("glint_manifold", "normalStrength", "strength"),
        ("glint_diffuse", "base_color", "reflectance"),
    ],
)
def test_names_of_other_renderers_are_known(variant, plugin, name, ours):
    with pytest.raises(RuntimeError, match=f'"{name}" is not a parameter, did you mean "{ours}"'):
        mi.load_dict({"type": plugin, name: 0.5})


def test_other_names_lead_to_parameters():
    known = set().union(*PARAMETERS.values())
    for name, ours in OTHER_NAMES.items():
        assert set(ours) <= known
        assert name == name.lower() and "_" not in name
