"""The scenes of glint_elements, after the figures of Yan et al. 2016: they load, and they glint."""

from __future__ import annotations

import math
import re
import shutil

import mitsuba as mi
import numpy as np
import pytest

from tests.scenes.test_scenes import SCENES, load, repeatability

# Scene, horizontal field of view, a window (fractions of rows and columns) that shows the material
# only, and parameters: maps so coarse that a small image resolves them, and almost no reliefs,
# which repeat between two renders just as glints do.
CASES = {
    "kettle_elements": (30, (0.50, 0.75, 0.25, 0.55), {"uv_scale": 0.5}),
    "car_paint": (
        30,
        (0.20, 0.40, 0.20, 0.80),
        {"uv_scale": 0.2, "flake_density": 600, "flake_sigma_r": 0.03},
    ),
    "leather_sofa": (
        32,
        (0.20, 0.36, 0.28, 0.48),
        {
            "leather_scale": 0.2,
            "leather_relief": 1e-6,
            "wood_relief": 1e-6,
            "max_depth": 2,
            "separate": "false",
        },
    ),
}
WIDTH, HEIGHT, SPP = 90, 60, 64
IMAGE = {"resx": WIDTH, "resy": HEIGHT, "spp": SPP}


@pytest.mark.parametrize("name", CASES)
def test_glints_where_a_smooth_material_has_none(variant, name, tmp_path):
    fov, window, coarse = CASES[name]
    pixel_spread = math.radians(fov) / WIDTH / math.sqrt(SPP)
    glints = repeatability(
        load(SCENES / f"{name}.xml", pixel_spread=pixel_spread, **IMAGE, **coarse), window
    )

    folder = shutil.copytree(SCENES, tmp_path / "scenes", ignore=shutil.ignore_patterns("*.py"))
    file = folder / f"{name}.xml"
    smooth = '<bsdf type="roughconductor"><float name="alpha" value="0.15"/></bsdf>'
    pattern = r'<bsdf type="glint_elements">.*?</bsdf>'
    text = re.sub(pattern, smooth, file.read_text(encoding="utf-8"), flags=re.DOTALL)
    file.write_text(text, encoding="utf-8")
    coarse = {key: value for key, value in coarse.items() if f"${key}" in text}
    smooth = repeatability(load(file, **IMAGE, **coarse), window)
    # Measured: 0.68 and 0.02 (kettle), 0.81 and 0.03 (car), 0.64 and 0.16 (sofa)
    assert glints > 0.4, glints
    assert smooth < 0.25, smooth


def test_strategies_of_the_textured_light(variant):
    """Both strategies together are closer to the converged image than each of them."""

    def images(bsdf_samples: int, emitter_samples: int, spp: int, seeds: range) -> np.ndarray:
        scene = load(
            SCENES / "textured_light.xml",
            **{"resx": 60, "resy": 40, "spp": spp, "uv_scale": 1, "pixel_spread": 0.002},
            bsdf_samples=bsdf_samples,
            emitter_samples=emitter_samples,
        )
        return np.array([np.array(mi.render(scene, seed=seed)).mean(axis=2) for seed in seeds])

    reference = images(1, 1, 256, range(9, 10))
    assert np.isfinite(reference).all() and reference.mean() > 0.1
    errors = {}
    for strategy in ((1, 0), (0, 1), (1, 1)):
        estimates = images(*strategy, 16, range(4))
        # Logarithms, so that a few bright pixels do not decide alone.
        errors[strategy] = np.abs(np.log(estimates + 0.01) - np.log(reference + 0.01)).mean()
    # Measured: 0.164 (BSDF), 1.59 (light), 0.150 (both)
    assert errors[1, 1] < 0.95 * min(errors[1, 0], errors[0, 1])
