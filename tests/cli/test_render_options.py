"""Options of rendering commands: their effects, errors and output."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from click.testing import CliRunner

from glintbsdf.cli import entry, render_options
from glintbsdf.scene import units

SCENE = """<scene version="3.0.0">
    <default name="spp" value="64"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="16"/><integer name="height" value="16"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <emitter type="point"><point name="position" x="0" y="1" z="3"/></emitter>
    <emitter type="constant"><rgb name="radiance" value="0.1"/></emitter>
    <shape type="rectangle"><bsdf type="diffuse"/></shape>
</scene>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units, "FEWEST", 512)  # units of 2 samples per pixel
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def run(variant, no_progress):
    def run(*arguments: object):
        command = ["render", "scene.xml", "-m", variant, "--keep-integrator"]
        return CliRunner().invoke(entry.commands, [*command, *map(str, arguments)])

    return run


def pixels(name: str = "scene.exr") -> np.ndarray:
    return np.array(mi.Bitmap(name))


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--workers", "2", "--scheduler", "tcp://a:1"], "excludes --scheduler"),
        (["--workers", "0"], "not in the range"),
        (["--memory-limit", "much"], 'must be auto or an amount such as 4GB (got "much")'),
        (["--time-limit", "soon"], 'must be a time such as 90s, 15m or 2h (got "soon")'),
        (["--time-limit", "0"], "must be a time"),
        (["--until-error", "0"], "not in the range"),
        (["--live", "live.jpg"], "must end in .exr or .png"),
        (["--scheduler", "tls://a:1", "--tls-cert", "scene.xml"], "needs all of"),
        (["--workers", "1", *(x for o in ("ca-file", "cert", "key")
                              for x in (f"--tls-{o}", "scene.xml"))], "TLS is for --scheduler"),
    ],
)  # fmt: skip
def test_wrong_options(run, folder, arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2 and message in result.output
    assert os.listdir() == ["scene.xml"]


@pytest.mark.parametrize(
    "text, seconds", [("90", 90), ("90s", 90), ("15m", 900), ("2h", 7200), ("1.5d", 129600)]
)
def test_durations(text, seconds):
    assert render_options._parse_duration(None, None, text) == seconds


def test_without_dask(run, folder, monkeypatch):
    find = render_options.importlib.util.find_spec
    monkeypatch.setattr(
        render_options.importlib.util,
        "find_spec",
        lambda name: None if name == "distributed" else find(name),
    )
    result = run("--workers", 2)
    assert result.exit_code == 1 and "many processes need Dask; install it with: " in result.output


def test_dask_is_not_imported_where_it_is_not_used(folder, variant):
    code = (
        "import sys; from glintbsdf.cli import entry; "
        f"entry.commands(['render', 'scene.xml', '-m', '{variant}'], standalone_mode=False); "
        "print([m for m in sys.modules if m.split('.')[0] in ('dask', 'distributed', 'tornado')])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]"


def test_until_error(run, folder):
    assert run().exit_code == 0
    complete = pixels()
    result = run("--until-error", 0.05)
    share, noise = result.stderr.split(" % of the samples, noise ")
    assert float(share) < 100 and float(noise) <= 0.05
    # The requested noise, against an image with more samples.
    difference = np.sqrt(np.mean((pixels() - complete) ** 2)) / complete.mean()
    assert 0.3 * float(noise) < difference < 1.5 * float(noise)


def test_time_limit(run, folder, monkeypatch):
    clock = iter(np.arange(0.0, 1e4, 0.25))
    monkeypatch.setattr("glintbsdf.scene.merging.time.monotonic", lambda: next(clock))
    result = run("--time-limit", "3s")
    assert result.exit_code == 0
    assert 0 < float(result.stderr.split(" %")[0]) < 100


def test_checkpoint(run, folder, variant):
    assert run("--checkpoint", "kept").exit_code == 0
    first = Path("scene.exr").read_bytes()
    Path("scene.exr").unlink()
    assert run("--checkpoint", "kept").exit_code == 0
    assert Path("scene.exr").read_bytes() == first
    result = run("--checkpoint", "kept", "--seed", 1)
    assert result.exit_code == 1
    assert "belongs to another rendering: its seed is 0, this one's is 1" in str(result.exception)
    (folder / "scene.xml").write_text(SCENE.replace("0.1", "0.2"))
    assert "its scene is" in str(run("--checkpoint", "kept").exception)


def test_a_live_picture(run, folder, monkeypatch):
    monkeypatch.setattr(render_options, "LIVE_INTERVAL", 0.0)
    assert run("--live", "live.png", "--spp", 64).exit_code == 0
    live = pixels("live.png")
    assert live.shape == (16, 16, 3) and live.mean() > 0


def test_workers(run, folder):
    pytest.importorskip("distributed")
    assert run().exit_code == 0
    one = Path("scene.exr").read_bytes()
    result = run("--workers", 2)
    assert result.exit_code == 0 and result.stdout == "scene.exr\n"
    assert Path("scene.exr").read_bytes() == one


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
def test_ctrl_c_ends_workers_as_well(folder, variant):
    """A terminal sends Ctrl-C to all processes at once. The finished part of the image is
    written."""
    pytest.importorskip("distributed")
    command = ["render", "scene.xml", "-m", variant, "--keep-integrator"]
    command += ["--workers", "2", "--spp", str(1 << 24)]
    process = subprocess.Popen(
        [sys.executable, "-m", "glintbsdf", *command, "--checkpoint", "kept"],
        stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 120
        while not list(Path("kept").glob("unit-*")) and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1)
        os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 1 and output == "scene.exr\n"
    assert errors.splitlines()[-1].startswith("Error: interrupted: scene.exr has "), errors
    assert np.isfinite(pixels()).all()
    deadline = time.monotonic() + 60
    with pytest.raises(ProcessLookupError):  # no process is left
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)
            time.sleep(0.5)
