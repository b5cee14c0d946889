"""Every XML and Python sample of the documentation pastes and runs."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.examples import EXAMPLES
from glintbsdf.maps import procedural

ROOT = Path(__file__).parents[2]
PAGES = (
    ROOT / "README.md",
    *sorted((ROOT / "plugins").glob("*.py")),
    *sorted((ROOT / "docs").rglob("*.rst")),
    *sorted((ROOT / "docs").glob("tutorials/*.md")),  # their code cells run as the site is built
)

# What cannot run here: it submits jobs, or logs in elsewhere. And a sample of the README that has a
# test of its own, at a lower quality.
ONLY_COMPILED = ("SLURMCluster(", "PBSCluster(", "SSHCluster(", "mi.cornell_box()")

SCENE = """<scene version="3.0.0">
    <integrator type="direct"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="8"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="glint_grid"/></shape>
</scene>"""


@dataclass(frozen=True)
class Sample:
    """A block of code: its page, its first line there, its language, and what it says."""

    page: Path
    line: int
    language: str
    code: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


DIRECTIVE = re.compile(
    r"^(?P<indent> *)\.\. code-(?:block|tab):: (?P<language>xml|python)\b.*\n"
    r"(?:(?P=indent) +:.*\n)*\n"  # options
    r"(?P<code>(?:(?P=indent) +.*\n|\n)+)",
    re.M,
)
FENCE = re.compile(r"^```(?P<language>xml|python)\n(?P<code>.*?\n)```$", re.M | re.S)


def samples(page: Path) -> list[Sample]:
    text = page.read_text(encoding="utf-8")
    found = FENCE if page.suffix == ".md" else DIRECTIVE
    return [
        Sample(
            page,
            text.count("\n", 0, match.start("code")) + 1,
            match["language"],
            textwrap.dedent(match["code"]),
        )
        for match in found.finditer(text)
    ]


WITH_SAMPLES = {str(page.relative_to(ROOT)): samples(page) for page in PAGES if samples(page)}


@pytest.fixture
def folder(tmp_path, variant, monkeypatch) -> Path:
    """A working folder with files under the names of the samples, but smaller."""
    small = procedural.scratched(96, length=30.0, width=3.0, slope=0.5, alpha=0.12, seed=3).normals
    (tmp_path / "meshes").mkdir()
    (tmp_path / "maps").mkdir()
    for name in ("scratched.exr", "maps/scratched.exr"):
        mi.Bitmap(np.dstack([small, np.ones((96, 96), np.float32)])).write(str(tmp_path / name))
    stored = np.rint(127.5 + 127.5 * np.dstack([small, np.sqrt(1 - (small**2).sum(axis=2))]))
    mi.Bitmap(stored.astype(np.uint8)).write(str(tmp_path / "your_normals.png"))
    EXAMPLES["vase"].made["vase.obj"](tmp_path / "your.obj")
    kettle = (ROOT / "scenes/meshes/kettle_body.ply").read_bytes()
    (tmp_path / "meshes/kettle_body.ply").write_bytes(kettle)
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "docs/examples")
    monkeypatch.delitem(sys.modules, "waves", raising=False)  # it registers when it is imported
    return tmp_path


def query(bsdf: mi.BSDF) -> None:
    """Ask the BSDF for a few directions. Some of them, or all, are above the horizon."""
    _, drawn, weight = suite.sample(bsdf, suite.View(du=(0.02, 0), dv=(0, 0.02)), 64)
    assert np.isfinite(np.array(weight)).all() and np.isfinite(np.array(drawn.wo)).all()
    assert (np.array(drawn.pdf) > 0).any()


def load(element: ElementTree.Element, folder: Path) -> None:
    """Load an element of a scene as it stands, in a scene, and query its BSDF."""
    text = ElementTree.tostring(element, encoding="unicode")
    if element.tag == "bsdf":
        text = f'<shape type="sphere">{text}</shape>'
    (folder / "pasted.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    scene = mi.load_file(str(folder / "pasted.xml"))
    if element.tag == "integrator":
        assert scene.integrator() is not None
    for shape in scene.shapes():
        query(shape.bsdf())


@pytest.mark.parametrize("page", WITH_SAMPLES)
def test_samples_paste_and_run(page, folder, variant):
    pasted: dict[str, object] = {"__name__": "pasted"}  # the samples of a page, one after the other
    for sample in WITH_SAMPLES[page]:
        if sample.language == "xml":
            for element in ElementTree.fromstring(f"<samples>{sample.code}</samples>"):
                load(element, folder)
            continue
        code = sample.code.replace("llvm_ad_rgb", variant)
        compiled = compile(code, str(sample), "exec")
        if any(words in code for words in ONLY_COMPILED):
            continue
        if "__main__" in code:  # processes that it starts import its file
            (folder / "pasted.py").write_text(code)
            subprocess.run([sys.executable, "pasted.py"], check=True)
            continue
        exec(compiled, pasted)
        if isinstance(pasted.get("bsdf"), mi.BSDF):
            query(pasted["bsdf"])


def test_all_plugins_have_samples_in_both_languages():
    for page in sorted((ROOT / "plugins").glob("glint_*.py")):
        languages = [sample.language for sample in samples(page)]
        assert {"xml", "python"} == set(languages), page.name
