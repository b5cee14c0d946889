"""Sequences: values, names, sheets and videos."""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from click.testing import CliRunner

from glintbsdf.cli import entry
from glintbsdf.scene import sequence
from glintbsdf.scene.sequence import SequenceError, frames_of, names_of, read_table, values_of

SCENE = """<scene version="3.0.0">
    <default name="grey" value="0.5"/>
    <default name="size" value="8"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="$size"/><integer name="height" value="6"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <integrator type="path"/>
    <emitter type="constant"><rgb name="radiance" value="$grey"/></emitter>
</scene>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def run(variant):
    def run(*arguments: object):
        command = ["sequence", "scene.xml", "-m", variant, "--keep-integrator"]
        command += map(str, arguments)
        return CliRunner().invoke(entry.commands, command)

    return run


# ---------------------------------------------------------------------------------------------
#  Values and names
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, values",
    [
        ("0:1:3", ["0", "0.5", "1"]),
        ("2:-2:2", ["2", "-2"]),
        ("1e-3:.1:2", ["0.001", "0.1"]),
        ("5:6:1", ["5"]),
        ("C:/maps/a.exr", None),
        ("1:2", None),
        ("0.5", None),
    ],
)
def test_ranges(text, values):
    assert values_of(text) == values


def test_frames():
    assert frames_of({"a": "0:1:2", "b": "x"}) == [{"b": "x", "a": "0"}, {"b": "x", "a": "1"}]
    both = frames_of({"a": "0:1:2", "b": "5:7:3"})
    assert [(f["a"], f["b"]) for f in both] == [(a, b) for a in "01" for b in "567"]
    assert frames_of({"a": "0:1:2", "b": "5:6:2"}, together=True) == [
        {"a": "0", "b": "5"},
        {"a": "1", "b": "6"},
    ]
    rows = [{"a": "1", "c": "p"}, {"a": "2", "c": "q"}]
    assert frames_of({"b": "y"}, rows) == [{"b": "y", **row} for row in rows]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (({"a": "1"},), "nothing makes frames"),
        (({"a": "0:1:0"},), "one value at least"),
        (({"a": "0:1:2", "b": "0:1:3"}, (), True), r"the same length \(got 2 and 3\)"),
        (({"a": "3"}, [{"a": "1"}]), '"a" is in the table and in -D'),
    ],
)
def test_frames_that_cannot_be(arguments, message):
    with pytest.raises(SequenceError, match=message):
        frames_of(*arguments)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_tables(tmp_path, delimiter):
    path = tmp_path / "t.csv"
    path.write_text("a, name\n1,x\n 2 ,y\n".replace(",", delimiter))
    assert read_table(path) == [{"a": "1", "name": "x"}, {"a": "2", "name": "y"}]
    for text, message in (("a,b\n", "has no rows"), ("", "no rows"), ("a,b\n1\n", "row 2"),
                          ("a\n1,2\n", "row 2")):  # fmt: skip
        path.write_text(text)
        with pytest.raises(SequenceError, match=message):
            read_table(path)


def test_names():
    frames = [{"a": "0.25", "m": "x"}, {"a": "0.5", "m": "y"}]
    assert names_of("f/{index:03}.exr", frames) == [Path("f/000.exr"), Path("f/001.exr")]
    assert names_of("{a:.1e}_{m}.png", frames) == [Path("2.5e-01_x.png"), Path("5.0e-01_y.png")]


@pytest.mark.parametrize(
    "template, frames, message",
    [
        ("out.exr", [{"a": "1"}, {"a": "2"}], "several frames the same name"),
        ("{b}.exr", [{"a": "1"}], 'has a field "b"; there are a, index'),
        ("{m}.exr", [{"m": "../../x"}], '"m" cannot be part of a name'),
        ("{m}.exr", [{"m": "/etc/x"}], "cannot be part"),
        ("{a:d}.exr", [{"a": "0.5"}], "format code"),
    ],
)
def test_names_that_cannot_be(template, frames, message):
    with pytest.raises(SequenceError, match=message):
        names_of(template, frames)


# ---------------------------------------------------------------------------------------------
#  The command
# ---------------------------------------------------------------------------------------------


def test_a_sweep(run, folder):
    result = run("-D", "grey=0.1:0.5:3", "-o", "out/{grey}.exr", "--sheet", "sheet.png")
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == ["out/0.1.exr", "out/0.3.exr", "out/0.5.exr", "sheet.png"]
    for value in (0.1, 0.3, 0.5):
        assert np.allclose(np.array(mi.Bitmap(f"out/{value}.exr")), value, rtol=1e-3)
    made = np.array(mi.Bitmap("sheet.png"))
    assert made.shape == (2 * 6 + 4, 2 * 8 + 4, 3)
    assert made[0, 0, 0] < made[0, 15, 0] < made[15, 0, 0] and made[15, 15, 0] == 255


def test_two_ranges_make_rows(run, folder):
    result = run("-D", "grey=0.1:0.9:2", "-D", "size=3:5:3", "--sheet", "sheet.png")
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in folder.glob("scene_*.exr")) == [
        f"scene_{index:04}.exr" for index in range(6)
    ]
    assert np.array(mi.Bitmap("sheet.png")).shape == (2 * 6 + 4, 3 * 5 + 2 * 4, 3)


def test_a_table_with_checkpoints(run, folder):
    (folder / "t.csv").write_text("grey,size\n0.1,4\n0.2,5\n")
    command = ["--table", "t.csv", "--checkpoint", "kept", "-o", "{index}.png"]
    assert run(*command).exit_code == 0
    assert sorted(p.name for p in (folder / "kept").iterdir()) == ["frame-000000", "frame-000001"]
    first = (folder / "1.png").read_bytes()
    assert run(*command).exit_code == 0 and (folder / "1.png").read_bytes() == first


def test_wrong_sequences(run, folder):
    for arguments, message in (
        ((), "nothing makes frames"),
        (("-D", "grey=0:1:2", "-o", "x.exr"), "the same name"),
        (("-D", "grey=0:1:2", "-o", "{index}.jpg"), "must end in .exr or .png"),
    ):
        result = run(*arguments)
        assert result.exit_code and message in result.output + str(result.exception)
    assert [p.name for p in folder.iterdir()] == ["scene.xml"]


def test_a_video_needs_ffmpeg(run, folder, monkeypatch):
    monkeypatch.setattr(sequence.shutil, "which", lambda name: None)
    result = run("-D", "grey=0:1:2", "--video", "out.mp4")
    assert "needs the program ffmpeg" in str(result.exception)
    assert [p.name for p in folder.iterdir()] == ["scene.xml"]


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script stands for ffmpeg")
def test_input_of_ffmpeg(run, folder, monkeypatch):
    """A program in place of ffmpeg records its input."""
    program = folder / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nfor last; do :; done\necho "$@" > arguments\ncat > "$last"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    result = run("-D", "grey=0.1:1:3", "--video", "out.mp4", "--rate", 12)
    assert result.exit_code == 0, result.output
    frames = np.frombuffer((folder / "out.mp4").read_bytes(), np.uint8).reshape(3, 6, 8, 3)
    assert (frames[0] < frames[1]).all() and (frames[2] == 255).all()
    assert "-s 8x6 -r 12" in (folder / "arguments").read_text()
    program.write_text("#!/bin/sh\necho no such codec >&2\nexit 1\n")
    failed = run("-D", "grey=0.1:1:3", "--video", "out.mp4")
    assert "ffmpeg: no such codec" in str(failed.exception)
