"""Surveys of scenes, renderings with trimmed structures, and the report of both."""

from __future__ import annotations

import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import maps
from glintbsdf.cli import entry as cli
from glintbsdf.scene import inspection, rendering
from tests.small_scenes import ball, square

SIZE = 128

# A square of 2 × 2 seen from above through a window: its middle eighth, so that a pixel is a texel.
SCENE = square(ball(0.45, 0, 0.3, radius=0.25), fov=3.5801, spp=64)


@pytest.fixture
def folder(tmp_path, monkeypatch, variant):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    normals = maps.isotropic(SIZE, seed=1).normals
    third = np.sqrt(1 - (normals**2).sum(axis=2, keepdims=True))
    mi.Bitmap(np.concatenate([normals, third], axis=2)).write("map.exr")
    return tmp_path


def load(**parameters) -> inspection.Inspected:
    return inspection.load("scene.xml", {key: str(value) for key, value in parameters.items()})


def image(inspected: inspection.Inspected, missed=lambda: False) -> np.ndarray:
    with rendering.Renderer(inspected.scene, missed=missed) as renderer:
        return np.array(rendering.produce(renderer).bitmap)


def test_survey_finds_what_the_sensor_sees(folder):
    (domain,) = inspection.survey(load())
    # The window shows texels 56 to 72. A footprint has half the width of one of 8 × 8 strata of a
    # pixel, a 16th of a texel, as its standard deviation, and reaches three times as far.
    for first, last in (domain.columns, domain.rows):
        assert 55 <= first <= 56 and 71 <= last <= 73
    assert 1 / 16 / 1.1 < domain.smallest <= 1 / 16 * 1.01
    assert 1 / 16 * 0.99 < domain.largest < 1 / 16 * 1.1


def test_survey_knows_the_samples_and_the_scale(folder):
    (domain,) = inspection.survey(load(), spp=16)
    (coarse,) = inspection.survey(load(scale=4))
    assert 1 / 8 / 1.1 < domain.smallest <= 1 / 8 * 1.01
    assert 1 / 4 / 1.1 < coarse.smallest <= 1 / 4 * 1.01


def test_survey_follows_whole_paths(folder):
    direct, indirect = (
        inspection.survey(load(integrator="glint_path", depth=depth))[0] for depth in (2, 6)
    )
    # The sphere, which is outside the image, reflects most of the square.
    assert direct.columns[1] - direct.columns[0] < 20
    assert indirect.columns[1] - indirect.columns[0] > 60
    assert indirect.largest > 4 * direct.largest


def test_survey_leaves_the_scene_as_it_was(folder):
    inspected = load()
    inspection.survey(inspected, spp=16)
    (bsdf,) = inspected.bsdfs
    assert bsdf.watch is None and bsdf.pixel_spread == 0 and bsdf.footprint_sigma == 0.5
    assert inspected.scene.sensors()[0].sampler().sample_count() == 64


@pytest.mark.parametrize(
    "plugin", ["glint_manifold", "glint_elements", "glint_filtered", "glint_diffuse"]
)
@pytest.mark.parametrize("path", [("path", 2), ("glint_path", 6)], ids=["direct", "indirect"])
def test_trimmed_rendering_is_the_same(folder, plugin, path):
    parameters = {"plugin": plugin, "integrator": path[0], "depth": path[1]}
    inspected = load(**parameters)
    trimmed = inspection.Trimmed(inspected)
    picture = image(inspected, trimmed.missed)
    kept = sum(inspected.bsdfs[0].parts().values())
    complete = inspection.Inspected(
        rendering.load_scene("scene.xml", {key: str(value) for key, value in parameters.items()}),
        [],
    )
    assert np.array_equal(picture, image(complete))
    inspection.build(inspected)
    whole = sum(inspected.bsdfs[0].parts().values())
    if path[0] == "path":
        assert trimmed.sufficed
        assert kept < whole or plugin == "glint_diffuse"  # which has only its vertices


@pytest.mark.parametrize("part", ["columns", "rows", "smallest", "largest"])
def test_an_incomplete_survey_only_costs_time(folder, monkeypatch, part):
    survey = inspection.survey

    def short_sighted(*arguments) -> list:
        wrong = {"columns": (60, 62), "rows": (60, 62), "smallest": 1.0, "largest": 0.01}
        return [replace(domain, **{part: wrong[part]}) for domain in survey(*arguments)]

    monkeypatch.setattr(inspection, "survey", short_sighted)
    monkeypatch.setattr("glintbsdf.footprint.domain.MARGIN_TEXELS", 0)
    inspected = load()
    trimmed = inspection.Trimmed(inspected)
    begun = []

    def missed() -> bool:
        begun.append(1)
        return trimmed.missed()

    picture = image(inspected, missed)
    assert not trimmed.sufficed and len(begun) == 2
    assert np.array_equal(picture, image(inspected))


def test_structures_that_no_path_meets_are_not_built(folder):
    text = SCENE.replace('origin="0,0,4" target="0,0,0"', 'origin="0,0,4" target="0,0,9"')
    (folder / "scene.xml").write_text(text)
    inspected = load()
    trimmed = inspection.Trimmed(inspected)
    picture = image(inspected, trimmed.missed)
    assert trimmed.sufficed and inspected.bsdfs[0].parts() == {} and np.ptp(picture) == 0
    (finding,) = inspection.inspect(load())
    assert finding.domain is None and finding.trimmed == {} and finding.complete
    assert "no path meets it" in str(finding) and "next to nothing" in str(finding)


def test_a_scene_without_glints(folder):
    inspected = load(plugin="glint_manifold")
    inspected = inspection.Inspected(inspected.scene, [])
    assert inspection.survey(inspected) == [] and inspection.inspect(inspected) == []


@pytest.fixture
def run(capsys, monkeypatch, variant):
    """Run the command line; return what it prints and its errors."""

    def run(*arguments: str) -> tuple[str, str]:
        monkeypatch.setattr(
            sys, "argv", ["glintbsdf", *arguments, "-m", variant, "--keep-integrator"]
        )
        with pytest.raises(SystemExit) as exit:
            cli.main()
        assert exit.value.code == 0
        captured = capsys.readouterr()
        return captured.out, captured.err

    return run


def test_inspect_prints_queries_structures_and_features_left_out(folder, run):
    output, _ = run("inspect", "scene.xml")
    lines = output.splitlines()
    assert lines[0] == 'glint_manifold "metal"'
    assert "128 × 128 texels, repeat" in output
    assert "footprints: standard deviations of 0.0625 to 0.0653 texels" in output
    complete = load()
    inspection.build(complete)
    total = sum(complete.bsdfs[0].parts().values())
    assert f"{total / 1e6:.1f} MB  together" in output and "MB  saved" in output
    assert "clusters: threshold is 0" in output and "tint: no specular_reflectance" in output


def test_inspect_says_where_nothing_can_be_saved(folder, run):
    output, _ = run("inspect", "scene.xml", "-D", "plugin=glint_diffuse")
    assert "saves nothing here" in output and "MB  vertices" in output


def test_inspect_of_a_bsdf_without_a_map(folder, run):
    text = SCENE.replace('<string name="filename" value="map.exr"/>', "")
    (folder / "scene.xml").write_text(text)
    output, _ = run("inspect", "scene.xml", "-D", "plugin=glint_grid")
    assert output.splitlines()[:2] == ['glint_grid "metal"', "  map       none"]
    assert "--trim" not in output


def test_render_with_trim(folder, run):
    run("render", "scene.xml", "-o", "whole.exr")
    output, errors = run("render", "scene.xml", "--trim", "-o", "trimmed.exr")
    assert output.split() == ["trimmed.exr"] and errors == ""
    whole, trimmed = (np.array(mi.Bitmap(name)) for name in ("whole.exr", "trimmed.exr"))
    assert np.array_equal(whole, trimmed)
