"""The package as a whole: effects of its import, and claims of the README."""

from __future__ import annotations

import importlib.metadata
import re
import runpy
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import glintbsdf
from glintbsdf.check.comparison import Comparison
from glintbsdf.check.reference import BinnedPNDF
from glintbsdf.check.truth import Truth
from glintbsdf.examples import EXAMPLES
from glintbsdf.footprint.query import Query

ROOT = Path(__file__).parents[1]


def python(script: str) -> str:
    """Run ``script`` in a fresh interpreter and return its output."""
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT / "tests",
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


def test_import_is_light_and_chooses_no_variant():
    output = python(
        "import sys, glintbsdf, mitsuba\nprint(mitsuba.variant(), *sorted(sys.modules), sep='\\n')"
    ).splitlines()
    assert output[0] == "None"
    heavy = {"numpy", "scipy", "skimage", "OpenEXR", "click", "rich", "matplotlib", "platformdirs"}
    assert not heavy & set(output)
    own = {name for name in output if name.startswith("glintbsdf")}
    bridge = {f"glintbsdf.bridge{name}" for name in ("", ".llvm", ".registration")}
    assert own == {"glintbsdf", "glintbsdf.core", "glintbsdf.core.errors", *bridge}


def test_choosing_a_variant_loads_no_image_or_plotting_library(variant):
    output = python(
        f"import sys, glintbsdf, mitsuba; mitsuba.set_variant('{variant}'); print(*sys.modules)"
    )
    assert not {"skimage", "OpenEXR", "click", "rich", "matplotlib", "scipy"} & set(output.split())


def test_a_bsdf_loads_what_reads_its_file_and_no_more(variant, tmp_path):
    """A map that is given as data needs no reader; libraries that only some plugins need are not
    loaded either."""
    output = python(
        f"import sys, glintbsdf, mitsuba as mi; mi.set_variant('{variant}')\n"
        "data = mi.TensorXf([0.1] * 128, (8, 8, 2))\n"
        "mi.load_dict({'type': 'glint_manifold', 'data': data, 'max_error': 0})\n"
        "mi.load_dict({'type': 'glint_filtered', 'data': data})\n"
        "print(*sys.modules)"
    )
    assert not {"skimage", "OpenEXR", "click", "rich", "matplotlib", "scipy"} & set(output.split())


@pytest.mark.parametrize("name", glintbsdf.__all__)
def test_public_names_load_on_first_use(name):
    assert getattr(glintbsdf, name) is not None
    assert name in dir(glintbsdf)


def test_what_a_notebook_shows_is_short(variant):
    """The last value of a notebook's cell is shown by its ``repr``: a few lines, and no arrays."""
    normal_map = glintbsdf.maps.scratched(16, length=8, width=2, seed=2)
    uv, du = mi.Point2f(0.5, 0.25), mi.Vector2f(0.01, 0)
    footprint = glintbsdf.Footprint(uv, du, mi.Vector2f(0, 0.02))
    many = glintbsdf.Footprint(mi.Point2f(mi.Float([0.1, 0.2]), 0), du, du)
    ones = np.ones((8, 8))
    binned = BinnedPNDF(ones, 0.1 * ones, ((-1, -0.5), (1, 0.5)))
    compared = Comparison("a title", ones, ones, binned, 64, 0.5, footprint, normal_map)
    shown = {
        repr(footprint): "uv=(0.5, 0.25), du=(0.01, 0), dv=(0, 0.02)",
        repr(many): "2 of them",
        repr(Query(many, spread=(du,))): "2 of them), spread",
        repr(binned): "8 × 8 bins, x -1 to 1, y -0.5 to 0.5, noise 7.98%",
        repr(compared): "a title: relative L1 difference 0.00%",
        repr(
            Truth(np.ones((4, 6, 3)), np.full((4, 6, 3), 0.02))
        ): "4 × 6 × 3, relative error 2.00%",
        repr(normal_map): "16 x 16",
        repr(EXAMPLES["vase"]): "vase",
        repr(mi.load_dict({"type": "glint_path"})): "max_depth = -1",
        repr(mi.load_dict({"type": "glint_manifold", "data": mi.TensorXf(ones[..., None])})): "8×8",
    }
    for text, part in shown.items():
        assert part in text
        assert len(text) < 400 and max(map(len, text.splitlines())) < 180, text


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        glintbsdf.nonsense  # noqa: B018


def test_metadata_agree_with_the_package():
    assert importlib.metadata.version("glintbsdf") == glintbsdf.__version__
    (autoload,) = importlib.metadata.entry_points(group="mitsuba", name="glintbsdf")
    assert autoload.load() is glintbsdf
    assert (Path(glintbsdf.__file__).parent / "py.typed").exists()


def test_every_package_folder_is_installed():
    """setuptools gets a list: a folder missing there would be missing in wheels only."""
    project = (ROOT / "pyproject.toml").read_text()
    listed = re.search(r"^packages = \[(.*?)\]$", project, re.M | re.S)[1]
    source = ROOT / "src"
    folders = {
        ".".join(path.parent.relative_to(source).parts) for path in source.rglob("__init__.py")
    }
    assert set(re.findall(r'"([^"]+)"', listed)) == folders | {"glintbsdf.plugins"}


def test_quick_start_is_two_commands():
    readme = (ROOT / "README.md").read_text()
    quick_start = readme.split("## Quick start")[1].split("\n## ")[0]
    commands = re.findall(r"^    (.*)$", quick_start, re.M)
    assert len(commands) == 2
    assert all(command.startswith("python3 -m venv .venv && ") for command in commands)
    for scene in re.findall(r"scenes/\S+\.xml", readme):
        assert (ROOT / scene).exists()


@pytest.mark.parametrize(
    "remote",
    [
        "https://forge.example/owner/name.git",
        "https://user:secret@forge.example/owner/name",
        "git@forge.example:owner/name.git",
        "ssh://git@forge.example/owner/name.git",
    ],
)
def test_the_package_page_shows_pictures(remote):
    setup = runpy.run_path(str(ROOT / "setup.py"))
    repository = setup["public_address"](remote)
    assert repository == "https://forge.example/owner/name"
    readme = (ROOT / "README.md").read_text()
    page = setup["with_addresses"](readme, repository)
    pictures, links = (
        re.findall(rf"{before}\[[^]]*\]\((.*?)\)", page) for before in ("!", "(?<!!)")
    )
    for addresses, kind in ((pictures, "raw"), (links, "blob")):
        own = [a for a in addresses if a.startswith(f"{repository}/{kind}/HEAD/")]
        assert own and all((ROOT / a.split("/HEAD/")[1]).exists() for a in own)
        assert all(a.startswith("https://") for a in addresses)


def test_a_package_that_is_built_from_a_folder_has_the_readme_as_it_is():
    setup = runpy.run_path(str(ROOT / "setup.py"))
    for folder in ("/srv/glintbsdf", "../glintbsdf.git", "user@host:glintbsdf", ""):
        assert setup["public_address"](folder) is None


def test_python_example_of_the_readme_runs(tmp_path, variant, monkeypatch):
    """The example as printed, with a lower quality."""
    readme = (ROOT / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", readme, re.S)
    assert len([line for line in example.splitlines() if line]) <= 8
    example = example.replace("llvm_ad_rgb", variant, 1).replace(
        "spp=64))", "spp=1), write_async=False)"
    )
    example = example.replace("box.png", str(tmp_path / "box.png"))
    monkeypatch.chdir(ROOT)
    exec(compile(example, "README.md", "exec"), {})
    assert (tmp_path / "box.png").stat().st_size > 0
