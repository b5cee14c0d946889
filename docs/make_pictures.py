"""Make the pictures of ``docs/pictures.yaml``: ``python docs/make_pictures.py [NAME…]``.

A name is that of a picture of the gallery, or of a plugin; without names, all pictures are made.
With ``--times`` nothing is drawn: what the pictures of the gallery take is measured, and written to
``docs/images/times.csv``.
"""

from __future__ import annotations

import csv
import shlex
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import yaml
from PIL import Image

import glintbsdf  # noqa: F401  (first: it names the LLVM library that Dr.Jit is to load)

import mitsuba as mi  # isort: skip

from glintbsdf.scene import passes, rendering
from glintbsdf.scene.estimation import column_of

ROOT = Path(__file__).parents[1]
IMAGES, SCENES = ROOT / "docs" / "images", ROOT / "scenes"

# Samples per pixel of a measurement, until one takes so many seconds.
MEASURED, ENOUGH = (1, 16), 1.0

# Pictures of a plugin's page: pixels along a side, samples per pixel, and colours, as the noise of
# glints hardly shrinks otherwise.
SIZE, SPP, COLOURS = 256, 32, 128


# --------------------------------------------------------------------------------------------------
#  The gallery
# --------------------------------------------------------------------------------------------------


def scene_of(picture: dict) -> Path:
    return SCENES / f"{picture.get('scene', picture['image'])}.xml"


def definitions(picture: dict) -> dict[str, str]:
    return {key: str(value) for key, value in picture.get("define", {}).items()}


def command(picture: dict) -> list[str]:
    """The command that makes a picture of the gallery."""
    if "command" in picture:
        return [sys.executable, *shlex.split(picture["command"])[1:]]
    target = IMAGES / f"{picture['image']}.png"
    line = [sys.executable, "-m", "glintbsdf", "render", str(scene_of(picture)), "-o", str(target)]
    line += ["--spp", str(picture["spp"])]
    for key, value in definitions(picture).items():
        line += ["-D", f"{key}={value}"]
    return line + ["--denoise"] * picture.get("denoise", False)


def processor_time(picture: dict) -> float:
    """Seconds that a picture's samples take on one core, which all cores share.

    A few samples per pixel are rendered, under the footprints of the whole number. The time of a
    few columns is subtracted, so that what is prepared for each rendering does not count for each
    sample.
    """
    scene = rendering.load_scene(scene_of(picture), definitions(picture))
    with rendering.Renderer(scene, picture["spp"], picture.get("denoise", False)) as renderer:
        whole = renderer.plan(0).film
        few = column_of(whole, 4 * whole.height)

        def seconds(tile: passes.Tile, samples: int) -> float:
            start = time.process_time()
            passes.sums_of_samples(
                renderer.scene, renderer.sensor, renderer.integrator, tile, samples, renderer.spp,
                0, renderer.shared,
            )  # fmt: skip
            return time.process_time() - start

        seconds(few, 1)  # compiles
        for samples in MEASURED:
            taken = seconds(whole, samples) - seconds(few, samples)
            if taken > ENOUGH:
                break
        return taken / (1 - few.pixels / whole.pixels) / samples * renderer.spp


def write_times(pictures: list[dict]) -> None:
    """Measure pictures of the gallery, and write them to the table beside what is there."""
    table = IMAGES / "times.csv"
    times = dict(list(csv.reader(table.open()))[1:]) if table.exists() else {}
    for picture in pictures:
        times[picture["image"]] = f"{processor_time(picture):.0f}"
        click.echo(f"{picture['image']}: {times[picture['image']]} s")
        with table.open("w", newline="") as file:
            csv.writer(file).writerows([("image", "processor seconds"), *sorted(times.items())])


# --------------------------------------------------------------------------------------------------
#  Pages of plugins
# --------------------------------------------------------------------------------------------------


def plugin_file(plugin: str, value: object) -> Path:
    return IMAGES / "plugins" / f"{plugin}_{value}.png"


def loadable(bsdf: dict) -> dict:
    """A BSDF of the list as ``mi.load_dict`` takes it."""
    bsdf = dict(bsdf)
    if "filename" in bsdf:
        bsdf["filename"] = str(SCENES / bsdf["filename"])
    if "to_uv" in bsdf:
        bsdf["to_uv"] = mi.ScalarTransform4f().scale([*bsdf["to_uv"], 1])
    for key, value in bsdf.items():
        if isinstance(value, list):
            bsdf[key] = {"type": "rgb", "value": value}
    return bsdf


def ball(bsdf: dict, integrator: dict) -> mi.Scene:
    """A ball under two small lamps in the studio."""
    look_at = mi.ScalarTransform4f().look_at([0, 0.9, 5], [0, 0, 0], [0, 1, 0])
    lamps = {
        f"lamp {k}": {
            "type": "sphere",
            "center": list(center),
            "radius": 0.06,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
        }
        for k, (center, radiance) in enumerate(
            [((2.6, 3.4, 3.2), (1100, 1000, 850)), ((-3.2, 1.6, 3.0), (600, 720, 900))]
        )
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "glint_path", "max_depth": 2, "hide_emitters": True}
            | integrator,
            "sensor": {
                "type": "perspective",
                "fov": 25,
                "to_world": look_at,
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE},
                "sampler": {"type": "independent"},
            },
            "studio": {"type": "envmap", "filename": str(SCENES / "studio.exr"), "scale": 0.7},
            **lamps,
            "ball": {
                "type": "sphere",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90),
                "bsdf": bsdf,
            },
        }
    )


def make_plugin(plugin: str, shown: dict) -> None:
    """The pictures of a plugin's page."""
    (IMAGES / "plugins").mkdir(exist_ok=True)
    for value in shown["values"]:
        varied = {shown["parameter"]: value}
        if plugin == "glint_path":
            scene = ball(loadable(shown["bsdf"]), varied)
        else:
            scene = ball(loadable({"type": plugin} | shown["bsdf"] | varied), {})
        bitmap = rendering.render(scene, shown.get("spp", SPP))
        pixels = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True))
        target = plugin_file(plugin, value)
        Image.fromarray(pixels).quantize(COLOURS, dither=Image.Dither.NONE).save(
            target, optimize=True
        )
        click.echo(f"{target.relative_to(ROOT)}: {target.stat().st_size // 1000} kB")


# --------------------------------------------------------------------------------------------------


@click.command()
@click.argument("names", nargs=-1)
@click.option("--times", is_flag=True, help="Measure pictures of the gallery; draw nothing.")
@click.option("-m", "--variant", default="llvm_ad_rgb", show_default=True)
def main(names: tuple[str, ...], times: bool, variant: str) -> None:
    """Make the pictures of the documentation, or those with the given names."""
    listed = yaml.safe_load((ROOT / "docs" / "pictures.yaml").read_text(encoding="utf-8"))
    gallery = {picture["image"]: picture for picture in listed["gallery"]}
    unknown = set(names) - gallery.keys() - listed["plugins"].keys()
    if unknown:
        raise click.UsageError(f"no picture is called {', '.join(sorted(unknown))}")
    mi.set_variant(variant)
    chosen = [picture for name, picture in gallery.items() if name in names or not names]
    if times:
        write_times(chosen)
        return
    for picture in chosen:
        subprocess.run(command(picture), check=True, cwd=ROOT)
    for plugin, shown in listed["plugins"].items():
        if plugin in names or not names:
            make_plugin(plugin, shown)


if __name__ == "__main__":
    main()
