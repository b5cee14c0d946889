"""The command line, run in this process: files, settings, messages and errors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from glintbsdf import NormalMap, maps
from glintbsdf.check.comparison import Comparison
from glintbsdf.check.reference import BinnedPNDF
from glintbsdf.cli import entry as cli
from glintbsdf.examples import EXAMPLES
from glintbsdf.scene import rendering, units
from tests.small_scenes import square, write_heights

SCENE = square()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a small scene and its map in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    mi.set_variant("scalar_rgb")
    write_heights(tmp_path / "map.exr")
    return tmp_path


@pytest.fixture
def run(capsys, monkeypatch, variant, no_progress):
    """Run the command line; return its exit status, its output and its errors."""

    def run(*arguments: str | Path, replaces: bool = False) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["glintbsdf", *map(str, arguments)])
        command = arguments[0] if arguments else ""
        if command in ("render", "pndf") and "-m" not in arguments:
            sys.argv += ["-m", variant]
        if command == "render" and not replaces:
            sys.argv.append("--keep-integrator")
        with pytest.raises(SystemExit) as exit:
            cli.main()
        captured = capsys.readouterr()
        code = exit.value.code
        if isinstance(code, str):  # like Python for sys.exit("message")
            return 1, captured.out, captured.err + code + "\n"
        return code, captured.out, captured.err

    return run


# ---------------------------------------------------------------------------------------------
#  render
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_render_writes_the_image_and_nothing_else(run, folder, name):
    before = set(folder.iterdir())
    status, output, errors = run("render", "scene.xml", "-o", name)
    assert (status, output, errors) == (0, f"{name}\n", "")
    assert set(folder.iterdir()) - before == {folder / name}
    image = np.array(mi.Bitmap(str(folder / name)))
    assert image.shape == (16, 16, 3)
    assert image.dtype == (np.float32 if name.endswith("exr") else np.uint8)
    assert image.mean() > 0


def test_output_has_the_permissions_of_a_new_file(run, folder):
    (folder / "plain").touch()
    assert run("render", "scene.xml")[0] == 0
    assert (folder / "scene.exr").stat().st_mode == (folder / "plain").stat().st_mode


def test_seed_decides_the_image(run, folder):
    images = []
    for seed in (3, 3, 4):
        assert run("render", "scene.xml", "--seed", seed, "--spp", 4)[0] == 0
        images.append(np.array(mi.Bitmap("scene.exr")))
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_glint_path_takes_the_place_of_path_and_says_so(run, folder):
    status, _, errors = run("render", "scene.xml", "--spp", 1, "-o", "path.exr", replaces=True)
    assert status == 0
    assert errors.startswith('Note: "glint_path" renders in place of the integrator "path"')
    assert "--keep-integrator" in errors and errors.count("\n") == 1
    own = ["render", "scene.xml", "--spp", 1, "-D", "integrator=glint_path", "-o", "own.exr"]
    assert run(*own, replaces=True) == (0, "own.exr\n", "")
    assert np.array_equal(*(np.array(mi.Bitmap(name)) for name in ("path.exr", "own.exr")))


def test_integrators_that_are_replaced(variant, folder):
    """``direct`` becomes a ``glint_path`` of the same depth, without glints nothing is replaced."""

    def found(**parameters: str) -> list[str]:
        return rendering.integrators_to_replace("scene.xml", parameters)

    assert found() == ["path"] and found(integrator="direct") == ["direct"]
    assert found(integrator="volpath") == found(plugin="roughconductor") == []
    node = mi.parser.SceneNode()
    node.props = mi.Properties("direct")
    node.props["hide_emitters"], node.props["emitter_samples"] = True, 4
    rendering.replace_integrator(node)
    assert node.props.plugin_name() == "glint_path"
    assert dict(node.props.items()) == {"hide_emitters": True, "max_depth": 2}


def test_definitions_reach_the_scene(run, folder):
    assert run("render", "scene.xml", "-D", "size=8", "-D", "sampler=multijitter")[0] == 0
    assert np.array(mi.Bitmap("scene.exr")).shape == (8, 8, 3)


def test_aov_images(run, folder):
    text = SCENE.replace(
        '<integrator type="$integrator"><integer name="max_depth" value="$depth"/>',
        '<integrator type="aov"><string name="aovs" value="dd:depth"/><integrator type="path"/>',
    )
    (folder / "aov.xml").write_text(text)
    assert run("render", "aov.xml", "--spp", 1)[0] == 0
    assert "dd.T" in [field.name for field in mi.Bitmap("aov.exr").struct_()]
    assert run("render", "aov.xml", "--spp", 1, "-o", "aov.png")[0] == 0
    colours = np.array(mi.Bitmap("aov.png"))
    assert colours.shape == (16, 16, 3) and colours.mean() > 128


def test_one_thread_does_not_hang(run, folder):
    """With one thread, Mitsuba would wait for a second one for ever while it reads the OpenEXR
    environment."""
    text = SCENE.replace(
        '<emitter type="constant"/>',
        '<emitter type="envmap"><string name="filename" value="map.exr"/></emitter>',
    )
    (folder / "envmap.xml").write_text(text)
    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        assert run("render", "envmap.xml", "--spp", 1)[0] == 0
    finally:
        dr.set_thread_count(count)


@pytest.mark.parametrize(
    "arguments, expected_status, message",
    [
        (["render", "missing.xml"], 2, "File 'missing.xml' does not exist"),
        (["render", "scene.xml", "-o", "out.jpg"], 2, 'must end in .exr or .png (got "out.jpg")'),
        (["render", "scene.xml", "--spp", "0"], 2, "0 is not in the range x>=1"),
        (["render", "scene.xml", "-D", "spp"], 2, 'must be key=value (got "spp")'),
        (["render", "scene.xml", "-m", "scalar_rgb"], 2, 'must be one of llvm_ad_rgb'),
        (["render", "scene.xml", "-D", "nothing=1"], 1, "unused parameters: - $nothing=1"),
        (["render", "scene.xml", "-D", "spread=-1"], 1, '"pixel_spread" must be a finite number'),
        (["render", "scene.xml", "-o", "nowhere/out.exr"], 1, "cannot write to nowhere/out.exr"),
        (["render", "no_sensor.xml"], 1, "no sensor"),
        (["render", "no_uvs.xml"], 1, 'the mesh "bare" has no UV coordinates'),
        (["render", "broken.xml"], 1, "broken.xml"),
        (["nonsense"], 2, "No such command 'nonsense'"),
    ],
)  # fmt: skip
def test_errors_are_one_line_and_leave_nothing(run, folder, arguments, expected_status, message):
    (folder / "no_sensor.xml").write_text('<scene version="3.0.0"/>')
    (folder / "broken.xml").write_text('<scene version="3.0.0">')
    bare = '<shape type="obj" id="bare"><string name="filename" value="bare.obj"/>'
    (folder / "no_uvs.xml").write_text(SCENE.replace('<shape type="rectangle">', bare))
    (folder / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    before = set(folder.iterdir())
    status, output, errors = run(*arguments)
    assert status == expected_status
    assert message in errors
    assert errors.startswith("Error: ") and errors.count("\n") == 1 and "Traceback" not in errors
    assert output == ""
    assert set(folder.iterdir()) == before


def test_debug_shows_the_traceback(run, folder, monkeypatch):
    with pytest.raises(RuntimeError, match="unused parameters"):
        monkeypatch.setattr(
            sys, "argv", ["glintbsdf", "--debug", "render", "scene.xml", "-D", "nothing=1"]
        )
        cli.main()


def test_unwritable_output_is_reported_before_rendering(run, folder, monkeypatch):
    monkeypatch.setattr(rendering, "load_scene", pytest.fail)
    (folder / "out.exr").mkdir()
    status, _, errors = run("render", "scene.xml", "-o", "out.exr")
    assert status == 1 and "out.exr is a folder" in errors


def test_a_failed_rendering_keeps_the_former_image(run, folder, monkeypatch):
    (folder / "scene.exr").write_text("former")

    def fail(*_):
        raise RuntimeError("half way")

    monkeypatch.setattr(rendering, "save", fail)
    before = set(folder.iterdir())
    assert run("render", "scene.xml")[0] == 1
    assert (folder / "scene.exr").read_text() == "former"
    assert set(folder.iterdir()) == before


def test_one_of_several_sensors(run, folder):
    far = SCENE.split("<sensor")[1].split("</sensor>")[0].replace("0,0,4", "0,0,40")
    (folder / "two.xml").write_text(
        SCENE.replace("<sensor", '<sensor id="near"').replace(
            "<emitter", f'<sensor id="far"{far}</sensor><emitter', 1
        )
    )
    images = {}
    for which in (None, "0", "1", "near", "far"):
        arguments = ["render", "two.xml", "--spp", 1, *([] if which is None else ["-s", which])]
        status, _, errors = run(*arguments)
        assert status == 0
        assert (errors == "") == (which is not None)
        images[which] = np.array(mi.Bitmap("two.exr"))
        if which is None:
            assert 'of the sensors 0 "near", 1 "far" the first is rendered, -s names' in errors
    assert np.array_equal(images[None], images["0"]) and np.array_equal(images["1"], images["far"])
    assert np.array_equal(images["0"], images["near"])
    assert not np.array_equal(images["0"], images["1"])
    status, _, errors = run("render", "two.xml", "-s", "side")
    assert status == 1 and 'no sensor "side" among 0 "near", 1 "far"' in errors
    status, report, _ = run("inspect", "two.xml", "-s", "far")
    assert status == 0 and report != run("inspect", "two.xml", "-s", "near")[1]


def test_files_of_the_scene_are_not_written_over(run, folder):
    content = (folder / "map.exr").read_bytes()
    (folder / "map.xml").write_text(SCENE)  # whose image would be map.exr
    for arguments in (["scene.xml", "-o", "map.exr"], ["map.xml"]):
        status, _, errors = run("render", *arguments)
        assert status == 1 and "map.exr is a file of the scene: name another with -o" in errors
    (folder / "map.png").write_bytes(content)
    arguments = ["--type", "glint_filtered", "--map", "map.png", "--uv", 0.5, 0.5, "--sigma", 2]
    status, _, errors = run("pndf", *arguments, "-o", "map.png")
    assert status == 2 and "must not be the map itself" in errors
    status, _, errors = run("synthesise", "map.exr", "-o", "map.exr")
    assert status == 2 and "must not be the map itself" in errors
    assert (folder / "map.exr").read_bytes() == content


def test_warnings_about_footprints_fit_the_scene(folder, variant, capfd):
    """With an orthographic camera, and on a curve, pixel_spread gives no footprint."""
    parallel = SCENE.replace("perspective", "orthographic").replace(
        '<float name="fov" value="30"/>', ""
    )
    scene = mi.load_string(parallel)
    rendering.render(scene, spp=1)
    text = "".join(capfd.readouterr())
    assert 'Use the integrator "glint_path", with an orthographic camera as well' in text
    (folder / "curve.txt").write_text("-1 0 0 0.1\n0 0.2 0 0.1\n1 0 0 0.1\n")
    curve = SCENE.replace(
        '<shape type="rectangle">',
        '<shape type="linearcurve"><string name="filename" value="curve.txt"/>',
    )
    scene = mi.load_string(curve.replace('name="spread" value="0"', 'name="spread" value="0.004"'))
    rendering.render(scene, spp=1)
    text = "".join(capfd.readouterr())
    assert "as curves do not" in text and '"pixel_spread" is 0' not in text


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_a_full_disk_is_reported(folder, variant, name):
    """Mitsuba writes as much as fits, or nothing, without an error; the command reports it."""
    before = set(folder.iterdir())
    code = (
        "import resource as r, sys; from glintbsdf.cli import entry; from glintbsdf.scene import "
        "rendering; save = rendering.save\n"
        "def full(*args):\n"
        "    r.setrlimit(r.RLIMIT_FSIZE, (40, r.getrlimit(r.RLIMIT_FSIZE)[1])); save(*args)\n"
        "rendering.save = full; entry.main()"
    )
    command = ["render", "scene.xml", "-m", variant, "-o", name, "--spp", "1"]
    result = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True)
    assert result.returncode == 1 and result.stdout == ""
    reason = (
        "I/O error" if name.endswith("exr") else "what has arrived on the disk is not the whole"
    )
    assert f"Error: cannot write {name}: {reason}" in result.stderr
    assert set(folder.iterdir()) == before


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
def test_interruption_leaves_nothing_half_done(folder, variant):
    before = set(folder.iterdir())
    command = [sys.executable, "-m", "glintbsdf", "render", "scene.xml", "-m", variant]
    process = subprocess.Popen(
        [*command, "-D", "size=512", "--spp", "65536"], stderr=subprocess.PIPE, text=True
    )
    try:
        deadline = time.monotonic() + 60
        while set(folder.iterdir()) == before and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.5)  # while it loads or renders
        os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()  # a process that does not end would slow all later tests
    assert process.returncode == 1
    error = errors.splitlines()[-1]  # an estimate and progress may come first
    left = set(folder.iterdir()) - before
    if left:
        assert left == {folder / "scene.exr"}
        assert error.startswith("Error: interrupted: scene.exr has ") and "%" in error
    else:
        assert error == "Aborted."


def test_interruption_keeps_what_is_done(run, folder, monkeypatch):
    """Three passes of sixteen give an unbiased image with three times the samples of one pass."""
    monkeypatch.setattr(units, "FEWEST", 256)
    original = rendering.Renderer.render

    def interrupted(self, unit):
        if unit.index == 3:
            signal.raise_signal(signal.SIGINT)
        return original(self, unit)

    monkeypatch.setattr(rendering.Renderer, "render", interrupted)
    status, output, errors = run("render", "scene.xml")
    assert (status, output) == (1, "scene.exr\n")
    assert "interrupted: scene.exr has 18.8 % of the samples" in errors
    assert np.array(mi.Bitmap("scene.exr")).mean() == pytest.approx(1, abs=0.1)


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
def test_interruption_under_another_name():
    """Dr.Jit's loops and Mitsuba's constructors replace the exception that ends them."""
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), cli.interruptible():
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise RuntimeError("dr.while_loop(): encountered an exception") from error
    with pytest.raises(RuntimeError, match="of its own"), cli.interruptible():
        raise RuntimeError("of its own")
    assert signal.getsignal(signal.SIGINT) is handler


# ---------------------------------------------------------------------------------------------
#  Footprints and passes
# ---------------------------------------------------------------------------------------------


def footprint_parameters(scene: mi.Scene) -> tuple[float, float]:
    parameters = mi.traverse(scene)
    (spread,) = (parameters[key][0] for key in parameters.keys() if key.endswith("pixel_spread"))
    (sigma,) = (parameters[key][0] for key in parameters.keys() if key.endswith("footprint_sigma"))
    return spread, sigma


def test_pixel_spread_is_that_of_the_field_of_view(folder, variant):
    sensor = rendering.load_scene("scene.xml", {"size": "256"}).sensors()[0]
    expected = 2 * np.tan(np.radians(30) / 2) / 256
    # Differences of two unit vectors in float32, 6e-8 of 2e-3.
    assert rendering.pixel_spread(sensor) == pytest.approx(expected, rel=1e-4)


def test_pixel_spread_of_a_parallel_projection_is_zero(variant):
    assert rendering.pixel_spread(mi.load_dict({"type": "orthographic"})) == 0


@pytest.mark.parametrize("own_spread", [0.0, 0.01])
def test_bsdfs_get_the_footprint_of_the_whole_image(folder, variant, own_spread):
    scene = rendering.load_scene("scene.xml", {"spread": str(own_spread)})
    sensor = scene.sensors()[0]
    before = footprint_parameters(scene)
    with rendering.footprints(scene, sensor, 16):
        spread, sigma = footprint_parameters(scene)
    assert footprint_parameters(scene) == before
    assert sigma == 0.5
    assert spread == pytest.approx(own_spread or rendering.pixel_spread(sensor) / 4, rel=1e-5)


def test_mean_of_passes_is_the_image(folder, variant, monkeypatch):
    """One pass and eight passes have the same mean, within the noise of both."""
    images = {}
    for size in (1 << 18, 512):
        monkeypatch.setattr(units, "FEWEST", size)
        fractions = []
        scene = rendering.load_scene("scene.xml")
        bitmap = rendering.render(scene, 16, 0, fractions.append)
        assert scene.sensors()[0].sampler().sample_count() == 16
        passes = len(fractions)
        images[passes] = np.array(bitmap)
        assert fractions == [(index + 1) / passes for index in range(passes)]
    assert set(images) == {1, 8}
    assert not np.array_equal(images[1], images[8])
    # A white furnace seen in a mirror: the image differs from 1 by lost multiple reflections only.
    # Means of 16 x 16 pixels of 16 samples: standard error measured below 0.01.
    assert images[1].mean() == pytest.approx(images[8].mean(), abs=0.04)


def test_stratified_samplers_render_in_one_pass(folder, variant, monkeypatch):
    monkeypatch.setattr(units, "FEWEST", 256)
    fractions = []
    scene = rendering.load_scene("scene.xml", {"sampler": "multijitter"})
    rendering.render(scene, report=fractions.append)
    assert fractions == [1]


def test_each_variant_renders(folder, each_variant):
    image = np.array(rendering.render(rendering.load_scene("scene.xml", {"size": "4"}), 1))
    assert np.isfinite(image).all() and image.max() > 0


# ---------------------------------------------------------------------------------------------
#  pndf
# ---------------------------------------------------------------------------------------------

PNDF = ["pndf", "--type", "glint_manifold", "--map", "map.exr", "--uv", 0.3, 0.6, "--sigma", 2]


def test_pndf_draws_and_agrees_with_the_reference(run, folder):
    status, output, errors = run(*PNDF, "--res", 32)
    assert (status, errors) == (0, "")
    difference, noise = (
        float(word.strip("%,:")) for word in output.split("\n")[0].split() if "%" in word
    )
    # With 32 x 32 bins of 16 points: noise about 10 %, and what it expects is what is seen.
    assert difference < 1.3 * noise and "they agree within the noise" in output
    assert "queries in" in output
    drawn = np.array(mi.Bitmap("pndf.png"))[..., :3]
    assert drawn.shape[1] > 2 * drawn.shape[0] and drawn.std() > 20


def test_pndf_without_a_map(run, folder):
    """The density beside a histogram of its own samples; as numbers."""
    seen = ["--uv", 0.3, 0.6, "--sigma", 0.05, "--res", 24, "-o", "pndf.npz"]
    flakes = ["--type", "glint_elements", "-D", "flake_density=20000", "-D", "sigma_r=0.03"]
    status, output, errors = run("pndf", *flakes, *seen)
    assert (status, errors) == (0, "") and "they agree within the noise" in output
    with np.load("pndf.npz") as numbers:
        assert numbers["density"].shape == numbers["reference"].shape == (24, 24)
        (x_min, y_min), (x_max, y_max) = numbers["bounds"]
        mass = numbers["density"].mean() * (x_max - x_min) * (y_max - y_min)
    assert 0.9 < mass < 1.01  # nearly all normals are on the grid
    _, output, _ = run("pndf", "--type", "glint_grid", "-D", "density=4", *seen)
    assert "draws from another distribution" in output


@pytest.mark.parametrize(
    ("difference", "predicted", "words"),
    [
        (0.10, 0.0, "within the noise"),
        (0.15, 0.1, "no more than the method predicts, 0.1"),
        (0.15, 0.0, "more than the noise"),
    ],
)
def test_the_verdict_of_a_comparison(difference, predicted, words):
    """Where noise makes about 8 %."""
    density, error = np.full((8, 8), 2.0), np.full((8, 8), 0.2)
    reference = BinnedPNDF(density, error, ((0.0, 0.0), (1.0, 1.0)))
    sign = np.where(np.indices((8, 8)).sum(axis=0) % 2, 1, -1)
    compared = Comparison(
        "", density * (1 + difference * sign), 0 * error, reference, 1, 1.0, None, maps.flat(2),
        predicted,
    )  # fmt: skip
    assert np.isclose(compared.difference, difference) and words in compared.verdict


def test_pndf_says_when_a_method_differs(run, folder):
    _, output, _ = run(*PNDF, "--type", "glint_filtered", "--res", 16)
    assert "differs from the reference by more than the noise" in output


def test_pndf_passes_parameters_on(run, folder):
    _, gaussian, _ = run(*PNDF, "--res", 16)
    _, box, _ = run(*PNDF, "--res", 16, "-D", "kernel=box", "-D", "height_scale=1.0")
    assert gaussian.split("\n")[0] != box.split("\n")[0]


@pytest.mark.parametrize("extra, message", [
    (["-D", "kernel=gauss"], 'glint_manifold: "kernel" must be one of gaussian, disk, box'),
    (["-D", "nothing=1"], '"nothing" is not a parameter'),
    (["--type", "diffuse"], "unreferenced property"),
    (["--sigma", "nan"], "must be"),
    (["-o", "pndf.exr"], "must end in .png, .pdf, .svg or .npz"),
])  # fmt: skip
def test_pndf_errors(run, folder, extra, message):
    before = set(folder.iterdir())
    status, _, errors = run(*PNDF, *extra)
    assert status in (1, 2)
    assert message in errors and errors.count("\n") == 1
    assert set(folder.iterdir()) == before


# ---------------------------------------------------------------------------------------------
#  Messages
# ---------------------------------------------------------------------------------------------


# ---------------------------------------------------------------------------------------------
#  synthesise
# ---------------------------------------------------------------------------------------------


def test_synthesise_writes_the_map_of_glint_mip(run, folder, variant):
    sample = maps.isotropic(40, seed=1)
    channels = np.dstack((sample.normals, np.sqrt(1 - (sample.normals**2).sum(axis=2))))
    OpenEXR.File({}, {"RGB": channels}).write("sample.exr")
    sizes = ("--output-size", 100, "--patch-size", 20, "--seed", 3)
    status, output, errors = run("synthesise", "sample.exr", "-o", "large.exr", *sizes)
    assert (status, errors) == (0, "")
    mi.set_variant(variant)  # the folder has left another
    assert output.startswith("40×40 texels made 100×100") and output.endswith("large.exr\n")
    bsdf = mi.load_dict(
        {
            "type": "glint_mip",
            "filename": "sample.exr",
            "output_size": 100,
            "patch_size": 20,
            "seed": 3,
        }
    )
    large = NormalMap.load("large.exr").normals
    assert np.allclose(large, bsdf.pndf.normal_map.normals, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "large.png"), "must end in .exr"),
        (("-o", "large.exr", "--patch-size", "9999"), 'synthesise: "patch_size" must be'),
    ],
)
def test_synthesise_errors(run, folder, arguments, message):
    OpenEXR.File({}, {"Y": np.zeros((40, 40), np.float32)}).write("sample.exr")
    status, output, errors = run("synthesise", "sample.exr", *arguments)
    assert status != 0 and output == "" and message in errors and errors.count("\n") == 1
    assert not list(Path().glob("large*"))


def test_errors_of_python_plugins_lose_their_traceback():
    message = (
        "[parser.cpp:1718] At scene.xml (line 3): failed to instantiate bsdf plugin of type "
        '"x": Traceback (most recent call last):\n  File "a.py", line 1, in <lambda>\n'
        '  File "b.py", line 2, in check\n'
        'glintbsdf.core.errors.ParameterError: x: "k" must be 1 (got 2)'
    )
    assert cli.one_line(message) == (
        'At scene.xml (line 3): failed to instantiate bsdf plugin of type "x": '
        'x: "k" must be 1 (got 2)'
    )


def test_a_long_rendering_is_foreseen(run, folder, monkeypatch):
    monkeypatch.setattr("glintbsdf.scene.estimation.LONG", 0.0)
    _, _, errors = run("render", "scene.xml")
    assert errors.startswith("Note: rendering takes about 0 s, and glints ")
    assert 'glint_manifold: "max_error" 0.05 bounds' in errors and "--time-limit" in errors


def test_help_names_the_commands(run):
    status, output, _ = run("--help")
    assert status == 0 and all(name in output for name in ("render", "pndf", "doctor"))


def test_examples_are_listed_and_copied(folder, run):
    status, listed, _ = run("example")
    assert status == 0 and [line.split()[0] for line in listed.splitlines()] == list(EXAMPLES)
    status, copied, told = run("example", "glitter", "-o", "new")
    assert status == 0 and copied == "new/scene.xml\n" and Path("new/scene.xml").is_file()
    assert told == "glintbsdf render new/scene.xml -o glitter.png\n"
    status, _, error = run("example", "glitter", "-o", "new")
    assert status == 1 and "new exists and is not an empty folder" in error
    assert run("example", "gliter")[0] == 2
