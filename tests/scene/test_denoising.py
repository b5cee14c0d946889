"""Denoising of indirect light only, and its requirements."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from click.testing import CliRunner

from glintbsdf.cli import entry as cli
from glintbsdf.scene import denoising, rendering, units
from tests.bridge.test_separation import manifold, parts, room

needs_denoiser = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba_oidn") is None,
    reason="the denoiser mitsuba-oidn is not installed",
)
SCENES = Path(__file__).parents[2] / "scenes"
GLINT_PATH = {"type": "glint_path", "max_depth": 6}
SAMPLER = {"type": "independent", "sample_count": 16}


def glinting_room(pixel_format: str = "rgb", size: int = 48, integrator: dict = GLINT_PATH):
    return room(
        manifold(), size=size, pixel_format=pixel_format, integrator=integrator, sampler=SAMPLER
    )


def pixels(bitmap: mi.Bitmap) -> np.ndarray:
    return np.array(bitmap)


@needs_denoiser
def test_direct_light_stays_as_it_is(variant, monkeypatch):
    """The image minus the denoiser's output is the direct image, with all glints."""
    _, direct, _ = parts(glinting_room(), spp=4, max_depth=6)
    monkeypatch.setattr(denoising, "denoise", lambda radiance, albedo, normal: 0 * radiance)
    monkeypatch.setattr(units, "FEWEST", 1 << 30)  # the seed as it is
    image = pixels(rendering.render(glinting_room(), spp=4, seed=1, denoise=True))
    assert direct.max() > 0
    # Mitsuba, which has rendered the other image, adds samples up in another order. Numbers too
    # small for the full precision of float32 are 0 in one of them.
    tiny = np.finfo(np.float32).tiny
    np.testing.assert_allclose(image, direct, rtol=1e-6, atol=tiny)


@needs_denoiser
def test_error_of_indirect_light_falls(variant, monkeypatch):
    """Against a reference with 32 times as many samples; the mean is kept."""
    noisy = []
    original = denoising.denoise

    def spy(radiance, albedo, normal):
        noisy.append((radiance, original(radiance, albedo, normal)))
        return noisy[-1][1]

    monkeypatch.setattr(denoising, "denoise", spy)
    rendering.render(glinting_room(), spp=16, seed=1, denoise=True)
    before, after = noisy[0]
    _, _, reference = parts(glinting_room(), spp=512, seed=2, max_depth=6)

    def error(image):
        return np.sqrt(np.mean((image - reference) ** 2))

    # Measured: 0.0577 and 0.0122, means 0.0672, 0.0661 and 0.0664
    assert error(after) < 0.3 * error(before)
    assert abs(after.mean() / before.mean() - 1) < 0.03
    assert abs(after.mean() / reference.mean() - 1) < 0.02


@needs_denoiser
def test_guides_are_those_of_the_visible_surfaces(variant, monkeypatch):
    """The albedo has no glints, and normals are those of the shapes."""
    guides = []
    monkeypatch.setattr(
        denoising, "denoise", lambda radiance, *images: guides.append(images) or radiance
    )
    rendering.render(glinting_room(), spp=1, denoise=True)
    albedo, normal = guides[0]
    plate = normal[..., 2] > 0.5
    assert plate.any() and np.allclose(normal[plate], [0, 0, 1], atol=1e-5)
    assert np.allclose(albedo[plate], 1, atol=1e-5)  # a perfect mirror


@needs_denoiser
def test_alpha_stays(variant):
    scene = glinting_room("rgba")
    image = pixels(rendering.render(scene, spp=4, denoise=True))
    expected = pixels(rendering.render(scene, spp=4))
    assert image.shape[-1] == 4 and np.allclose(image[..., 3], expected[..., 3], atol=1e-6)


@needs_denoiser
def test_in_each_variant(each_variant):
    image = pixels(rendering.render(glinting_room(size=16), spp=1, denoise=True))
    assert image.shape == (16, 16, 3) and np.isfinite(image).all() and image.mean() > 0


@needs_denoiser
def test_the_scene_stays_as_it_was(variant):
    scene = glinting_room(size=8)
    rendering.render(scene, spp=1, denoise=True)
    assert scene.integrator().separate is False
    assert pixels(rendering.render(scene, spp=1)).shape[-1] == 3


def test_other_integrators_are_refused(variant):
    with pytest.raises(ValueError, match='needs the integrator "glint_path".*Path'):
        rendering.render(glinting_room(integrator={"type": "path"}), denoise=True)


def test_missing_denoiser(variant, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="pip install mitsuba-oidn"):
        rendering.render(glinting_room(), denoise=True)


@needs_denoiser
def test_sheet_of_the_parts(variant, tmp_path):
    """The script for contact sheets, with the scene that is made for it."""
    spec = importlib.util.spec_from_file_location("sheets", SCENES / "sheets.py")
    sheets = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sheets)
    size = {"resx": "30", "resy": "20"}
    scene = rendering.load_scene(SCENES / "interreflection.xml", size)
    direct, indirect, filtered, whole = sheets.parts(scene, 4)
    assert np.all(np.array([direct.mean(), indirect.mean(), filtered.mean()]) > 0.01)
    assert np.allclose(direct + filtered, whole) and not np.allclose(indirect, filtered)
    assert tuple(sheets.two_by_two([direct, indirect, filtered, whole]).size()) == (60, 40)

    arguments = [str(SCENES / "kettle.xml"), "-o", str(tmp_path / "sheet.png")]
    refused = CliRunner().invoke(sheets.sheets, ["separated", *arguments])
    assert refused.exit_code == 2 and '"glint_path" with "separate" on' in refused.output


@needs_denoiser
def test_command_line(variant, tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        """<scene version="3.0.0">
            <integrator type="glint_path"/>
            <sensor type="perspective">
                <transform name="to_world"><translate z="-4"/></transform>
                <film type="hdrfilm">
                    <integer name="width" value="16"/><integer name="height" value="16"/>
                </film>
                <sampler type="independent"/>
            </sensor>
            <emitter type="constant"/>
            <shape type="sphere"><bsdf type="glint_grid"/></shape>
        </scene>"""
    )
    arguments = ["render", str(scene), "-o", str(tmp_path / "image.exr"), "--denoise"]
    result = CliRunner().invoke(cli.commands, arguments, catch_exceptions=False)
    assert result.exit_code == 0 and (tmp_path / "image.exr").exists()
