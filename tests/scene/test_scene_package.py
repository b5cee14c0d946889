"""Scenes that are sent: they are complete, identified by content, and never leave the receiver's
folder."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.scene import package, rendering
from glintbsdf.scene.package import BadPackage, Content, Job, Package, Store, pieces

SCENE = """<scene version="3.0.0">
    <default name="map" value="../maps/heights.exr"/>
    <default name="alpha" value="0.1234567"/>
    <include filename="../parts/camera.xml"/>
    <integrator type="path"/>
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <shape type="rectangle">
        <bsdf type="glint_filtered">
            <string name="filename" value="$map"/>
            <float name="alpha" value="$alpha"/>
        </bsdf>
    </shape>
</scene>
"""
CAMERA = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,0.3,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="12"/><integer name="height" value="10"/>
        </film>
    </sensor>
</scene>
"""


@pytest.fixture
def folder(tmp_path: Path, variant) -> Path:
    """A scene whose files are beside it, above it, and in another folder."""
    root = tmp_path / "sender"
    for name in ("scenes", "maps", "parts"):
        (root / name).mkdir(parents=True)
    (root / "scenes" / "scene.xml").write_text(SCENE)
    (root / "parts" / "camera.xml").write_text(CAMERA)
    random = np.random.default_rng(1)
    for name, size, channels in (
        ("maps/heights", 16, 1),
        ("maps/other", 8, 1),
        ("scenes/sky", 8, 3),
    ):
        pixels = random.random((size, size, channels), dtype=np.float32)
        mi.Bitmap(pixels).write(str(root / f"{name}.exr"))
    return root


def sent(made: Package, store: Store) -> None:
    for content in made.missing(store):
        for piece in pieces(content):
            store.receive(content, *piece)


def elsewhere(made: Package) -> Package:
    """The package as on a machine that has none of the sender's files."""
    return replace(
        made,
        documents=tuple((n, replace(c, path="/nowhere" + c.path)) for n, c in made.documents),
        files=tuple((n, replace(c, path="/nowhere" + c.path)) for n, c in made.files),
    )


def image(scene: mi.Scene) -> np.ndarray:
    return np.array(rendering.render(scene, 4))


def test_a_scene_travels_whole(folder, tmp_path):
    definitions = {"alpha": "0.2"}
    scene = folder / "scenes" / "scene.xml"
    expected = image(rendering.load_scene(scene, definitions))
    made = Package.of(scene, definitions)
    assert sorted(name for name, _ in made.files) == ["../maps/heights.exr", "sky.exr"]
    assert [name for name, _ in made.documents] == ["scenes/scene.xml", "parts/camera.xml"]

    store = Store(tmp_path / "receiver")
    there = pickle.loads(pickle.dumps(elsewhere(made)))
    assert len(there.missing(store)) == 4
    for content in made.contents:
        for piece in pieces(content):
            store.receive(content, *piece)
    shutil.move(folder, tmp_path / "gone")
    assert there.missing(store) == []
    assert np.array_equal(image(there.load(store)), expected)


@pytest.mark.parametrize("absolute", [False, True])
def test_files_by_parameters(folder, tmp_path, absolute):
    name = str(folder / "maps" / "other.exr") if absolute else "../maps/other.exr"
    made = Package.of(folder / "scenes" / "scene.xml", {"map": name})
    assert name in dict(made.files)
    scene = made.load(Store(tmp_path / "receiver"))
    expected = rendering.load_scene(folder / "scenes" / "scene.xml", {"map": name})
    assert np.array_equal(image(scene), image(expected))


def test_the_digest_is_of_content(folder, tmp_path):
    scene = folder / "scenes" / "scene.xml"
    made = Package.of(scene)
    shutil.copytree(folder, tmp_path / "copy")
    assert Package.of(tmp_path / "copy" / "scenes" / "scene.xml").digest == made.digest
    assert Package.of(scene, {"alpha": "0.3"}).digest != made.digest
    shutil.copy(folder / "maps" / "other.exr", folder / "maps" / "heights.exr")
    assert Package.of(scene).digest != made.digest


def test_a_file_in_place_is_not_sent(folder, tmp_path):
    made = Package.of(folder / "scenes" / "scene.xml")
    store = Store(tmp_path / "receiver")
    assert made.missing(store) == []
    # Another file with the same name is.
    shutil.copy(folder / "maps" / "other.exr", folder / "maps" / "heights.exr")
    assert [c.path for c in made.missing(store)] == [
        str(folder / "scenes" / ".." / "maps" / "heights.exr")
    ]
    with pytest.raises(ValueError, match="has been changed since the rendering began"):
        sent(made, store)


def test_a_missing_file_is_named(folder):
    (folder / "maps" / "heights.exr").unlink()
    with pytest.raises(RuntimeError, match="heights.exr"):
        rendering.load_scene(folder / "scenes" / "scene.xml")


@pytest.mark.parametrize("size", [0, 1, package.PIECE, package.PIECE + 1])
def test_files_arrive_in_pieces(tmp_path, size):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(np.random.default_rng(size).integers(0, 256, size, np.uint8)))
    content = replace(Content.of(path), path="/nowhere")
    store = Store(tmp_path / "receiver")
    assert store.find(content) is None
    for piece in pieces(Content.of(path)):
        store.receive(content, *piece)
    assert store.find(content).read_bytes() == path.read_bytes()
    assert len(list(store.folder.iterdir())) == 1


def test_content_that_does_not_match_its_digest_is_removed(tmp_path):
    store = Store(tmp_path / "receiver")
    content = Content("0" * 40, ".exr", "/nowhere")
    with pytest.raises(BadPackage, match="another file"):
        store.receive(content, 0, b"nonsense", True)
    assert list(store.folder.iterdir()) == []
    with pytest.raises(BadPackage, match="missing"):
        store.receive(content, 4, b"", False)


@pytest.mark.parametrize(
    "digest, suffix",
    [("../../etc/passwd", ""), ("0" * 39 + "/", ""), ("0" * 40, "/../../x"), ("0" * 40, ".a/b")],
)
def test_digest_and_suffix_contain_no_path(tmp_path, digest, suffix):
    content = Content(digest, suffix, "/nowhere")
    for action in (
        lambda: Store(tmp_path / "receiver").find(content),
        lambda: Store(tmp_path / "receiver").receive(content, 0, b"", True),
    ):
        with pytest.raises(BadPackage):
            action()
    assert list(tmp_path.rglob("*")) in ([], [tmp_path / "receiver"])


@pytest.mark.parametrize(
    "name", ["../x.xml", "/etc/x.xml", "a/../../x.xml", "", ".", "..\\x.xml", "C:/x.xml", "link/x"]
)
def test_documents_stay_inside_the_folder(folder, tmp_path, name):
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "link").symlink_to(tmp_path)
    if name == "link/x":
        with pytest.raises(BadPackage, match="leads out"):
            package.inside(tmp_path / "inner", name)
        return
    made = Package.of(folder / "scenes" / "scene.xml")
    bad = replace(made, documents=((name, made.documents[0][1]), *made.documents[1:]))
    with pytest.raises(BadPackage, match="leads out"):
        bad.load(Store(tmp_path / "receiver"))


def test_versions_are_compared(monkeypatch):
    assert package.version_difference(package.versions()) is None
    older = {**package.versions(), "mitsuba": "3.0.0"}
    assert "mitsuba" in package.version_difference(older)
    assert "3.0.0" in package.version_difference(older)
    assert package.version_difference({}) is not None


def test_a_job_is_described_by_what_decides_the_image(folder):
    job = Job(Package.of(folder / "scenes" / "scene.xml"), "llvm_ad_rgb", 16, 0)
    assert replace(job, trim=True).description() == job.description()
    for change in ({"spp": 17}, {"seed": 1}, {"variant": "llvm_ad_mono"}, {"denoise": True}):
        assert replace(job, **change).description() != job.description()
