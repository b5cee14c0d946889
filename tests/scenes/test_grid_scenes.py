"""The scenes of glint_grid: they load and glint, and the script makes a contact sheet of an
animation."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import skimage.io
from click.testing import CliRunner

SCENES = Path(__file__).parents[2] / "scenes"
# Scene, horizontal field of view, and a window (rows, columns) of a 60 × 60 image on the material
CASES = {
    "dress": (26, (20, 50, 20, 40)),
    "snow": (36, (30, 58, 5, 55)),
    "sand": (36, (30, 58, 5, 55)),
    "brushed_aluminium": (34, (20, 34, 42, 56)),
}
SIZE, SPP = 60, 16


def render(name: str, **parameters: str) -> np.ndarray:
    """Logarithm of the luminance in the window of an image of the scene ``name``."""
    fov, (top, bottom, left, right) = CASES[name]
    scene = mi.load_file(
        str(SCENES / f"{name}.xml"),
        resx=str(SIZE),
        resy=str(SIZE),
        spp=str(SPP),
        pixel_spread=str(math.radians(fov) / SIZE / SPP**0.5),
        **parameters,
    )
    image = np.array(mi.render(scene, seed=1))
    assert np.isfinite(image).all() and image.mean() > 0.01
    return np.log(image.mean(axis=2)[top:bottom, left:right] + 1e-3)


@pytest.mark.parametrize("name", CASES)
def test_glints(variant, name):
    # Vertical contrast (grooves run across), against that of microdetails too small to be seen
    glints, dense = (
        np.abs(np.diff(render(name, density=density), axis=0)).mean() for density in ("5", "14")
    )
    # Measured: 2.3 (sand) to 3.2 (dress)
    assert glints > 1.6 * dense, (glints, dense)


def test_contact_sheet(variant, tmp_path):
    spec = importlib.util.spec_from_file_location("sheets", SCENES / "sheets.py")
    sheets = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sheets)
    output = tmp_path / "sheet.png"
    options = ["-o", str(output), "-m", variant, "--frames", "7", "--spp", "1"]
    options += ["-D", "resx=24", "-D", "resy=16"]
    command = ["animate", str(SCENES / "dress.xml"), *options]
    CliRunner().invoke(sheets.sheets, command, catch_exceptions=False)
    sheet = skimage.io.imread(output)
    assert sheet.shape == (2 * 16, 5 * 24, 3)
    first, second, missing = sheet[:16, :24], sheet[:16, 24:48], sheet[16:, 48:]
    assert (first != second).any() and missing.max() == 0
    missing = CliRunner().invoke(sheets.sheets, ["animate", str(tmp_path / "missing.xml")])
    assert missing.exit_code == 2 and "does not exist" in missing.output
