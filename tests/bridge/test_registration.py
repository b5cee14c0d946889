"""Plugins are registered in every variant, for any order of imports and changes of variant."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from glintbsdf.bridge import registration
from glintbsdf.pndf import base


def a_plugin() -> dict:
    return {"type": "glint_manifold", "data": dr.zeros(mi.TensorXf, (2, 2, 2))}


def test_plugin_types_are_the_plugin_modules():
    assert {"glint_manifold", "glint_path"} <= set(registration.plugin_types())


def test_plugins_survive_changes_of_variant(variant):
    other = variant.replace("rgb", "mono") if "rgb" in variant else variant
    for name in (variant, "scalar_rgb", other, variant, other, variant):
        mi.set_variant(name)
        if not name.startswith("scalar"):
            bsdf = mi.load_dict(a_plugin())
            assert isinstance(bsdf, mi.BSDF)
            assert isinstance(mi.load_dict({"type": "glint_path"}), mi.Integrator)


@pytest.mark.parametrize("plugin_type", registration.plugin_types())
def test_kind_of_a_plugin_is_the_same_in_scalar_variants(plugin_type, variant):
    mi.set_variant("scalar_rgb")
    mi.set_variant(variant)
    try:
        mi.load_dict({"type": plugin_type})
    except RuntimeError as error:  # that parameters are missing does not matter here
        assert "Type mismatch" not in str(error)


def test_each_variant_has_the_plugins(each_variant):
    assert isinstance(mi.load_dict(a_plugin()), mi.BSDF)


def test_objects_of_a_former_variant_still_work(variant):
    if "rgb" not in variant:
        pytest.skip("needs an RGB variant to change from")
    bsdf = mi.load_dict(a_plugin())
    mi.set_variant(variant.replace("rgb", "mono"))
    mi.set_variant(variant)
    assert "GlintManifold" in str(bsdf)


def test_installing_again_registers_once(variant, monkeypatch):
    calls = []
    monkeypatch.setattr(registration, "register", calls.append)
    registration.install()
    registration.install()
    calls.clear()
    mi.set_variant("scalar_rgb")
    assert calls == ["scalar_rgb"]


@pytest.mark.parametrize("plugin", ["bsdf:glint_manifold", "integrator:glint_path"])
def test_scalar_variant_is_refused_with_the_lines_to_type(plugin):
    kind, plugin_type = plugin.split(":")
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError) as error:
        mi.load_string(f'<scene version="3.0.0"><{kind} type="{plugin_type}"/></scene>')
    assert f"{plugin_type}: needs a JIT variant of Mitsuba" in str(error.value)
    assert 'mi.set_variant("llvm_ad_rgb")' in str(error.value)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 keeps what a raise has left")
@pytest.mark.parametrize("plugin", ["glint_grid", "glint_manifold", "glint_path"])
def test_an_error_about_a_parameter_is_one_sentence(variant, plugin):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": plugin, "wrong": 1})
    message = str(error.value)
    assert f'ParameterError: {plugin}: "wrong" is not a parameter: it has ' in message
    assert "Traceback" not in message and len(message.splitlines()) == 1


def test_an_unused_parameter_is_refused(variant):
    with pytest.raises(RuntimeError, match='glint_manifold: "layer" is of no use beside the other'):
        mi.load_dict({**a_plugin(), "layer": "a"})


def test_other_errors_keep_their_traceback(variant):
    def broken(props):
        raise TypeError("a fault of the plugin itself")

    registration.register_plugin("glint_broken", broken)
    with pytest.raises(RuntimeError, match="(?s)Traceback.*TypeError: a fault of the plugin"):
        mi.load_dict({"type": "glint_broken"})


def test_base_classes_by_their_public_name_are_those_of_the_active_variant(variant):
    from glintbsdf import bsdf

    made = mi.load_dict({"type": "glint_grid"})
    assert isinstance(made, bsdf.GlintBSDF) and isinstance(made, bsdf.FootprintBSDF)
    with pytest.raises(AttributeError, match="nothing"):
        _ = bsdf.nothing


WAVES = Path(__file__).parents[2] / "docs" / "examples"


@pytest.fixture
def waves(variant, monkeypatch):
    """The module of the page "Write your own P-NDF", which Python finds."""
    monkeypatch.syspath_prepend(WAVES)
    monkeypatch.delitem(sys.modules, "waves", raising=False)  # it registers when it is imported
    return "waves"


def test_plugins_of_others_survive_changes_of_variant(waves, variant):
    registration.add_plugins(waves)
    for name in (variant, variant.replace("rgb", "mono"), "scalar_rgb", variant):
        mi.set_variant(name)
        if not name.startswith("scalar"):
            assert isinstance(mi.load_dict({"type": "glint_waves"}), mi.BSDF)
    assert base.methods()["waves"].plugin == "glint_waves"


def test_entry_points_are_plugins(waves, variant, monkeypatch):
    entry = EntryPoint("waves", "waves", registration.GROUP)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [entry])
    mi.set_variant("scalar_rgb")
    mi.set_variant(variant)
    assert isinstance(mi.load_dict({"type": "glint_waves"}), mi.BSDF)


def test_a_module_that_is_not_there(variant):
    for name in (variant, "scalar_rgb"):
        mi.set_variant(name)
        with pytest.raises(ModuleNotFoundError, match="no_such_module"):
            registration.add_plugins("no_such_module")
    assert "no_such_module" not in registration.modules_of_others()
