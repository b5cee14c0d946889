"""Contact sheets of scenes: frames of a circling camera, and the parts of separated light.

``python scenes/sheets.py animate scenes/dress.xml -o dress_sheet.png``
``python scenes/sheets.py separated scenes/interreflection.xml -o separated.png``
"""

from __future__ import annotations

from pathlib import Path

import click
import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401  (makes the plugins known)
from glintbsdf.core.progress import progress
from glintbsdf.scene import rendering

COLUMNS = 5


@click.group()
def sheets() -> None:
    """Put several pictures of a scene onto one sheet."""


def definitions(_context: click.Context, _parameter: click.Parameter, values: tuple) -> dict:
    """Parameters of a scene from KEY=VALUE."""
    if not all("=" in value for value in values):
        raise click.BadParameter("must be KEY=VALUE")
    return dict(value.split("=", 1) for value in values)


def sheet_options(command: click.Command) -> click.Command:
    """Add what both commands take: the scene, the sheet, samples, parameters, the variant."""
    existing = click.Path(exists=True, dir_okay=False, path_type=Path)
    command.params[:0] = [click.Argument(["scene"], type=existing)]
    command.params += [
        click.Option(["-o", "--output"], type=click.Path(path_type=Path), metavar="PNG",
                     help="The sheet; default: named after the scene."),
        click.Option(["--spp"], type=click.IntRange(1), help="Samples; default: the scene's."),
        click.Option(["-D", "--define"], multiple=True, callback=definitions,
                     metavar="KEY=VALUE", help="Parameter of the scene; may be repeated."),
        click.Option(["-m", "--variant"], default="llvm_ad_rgb", show_default=True),
    ]  # fmt: skip
    return command


# --------------------------------------------------------------------------------------------------
#  Frames
# --------------------------------------------------------------------------------------------------


def frames(scene: mi.Scene, count: int, degrees: float, spp: int | None):
    """Render ``count`` frames and yield each as an array of 8-bit sRGB pixels."""
    parameters = mi.traverse(scene.sensors()[0])
    start = mi.ScalarTransform4f(np.array(parameters["to_world"].matrix).reshape(4, 4))
    for index in range(count):
        angle = degrees * (index / max(count - 1, 1) - 0.5)
        parameters["to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], angle) @ start
        parameters.update()
        bitmap = rendering.render(scene, spp)
        yield np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True))


def contact_sheet(images: list[np.ndarray]) -> np.ndarray:
    """The images in rows of ``COLUMNS``; what the last row lacks is black."""
    missing = -len(images) % COLUMNS
    images = images + [np.zeros_like(images[0])] * missing
    return np.vstack([np.hstack(images[k : k + COLUMNS]) for k in range(0, len(images), COLUMNS)])


@sheet_options
@sheets.command()
@click.option("--frames", "count", type=click.IntRange(1), default=10, show_default=True)
@click.option("--degrees", default=2.0, show_default=True, help="The turn in all.")
def animate(
    scene: Path,
    count: int,
    degrees: float,
    output: Path | None,
    spp: int | None,
    define: dict[str, str],
    variant: str,
) -> None:
    """Frames of a scene while its camera circles, on one sheet: do the glints hold still?

    The camera turns about the scene's vertical axis; the sheet shows the frames in rows of five.
    Frames share their random numbers, so that what changes is the glints and the view.
    """
    mi.set_variant(variant)
    loaded = rendering.load_scene(scene, define)
    output = output or Path(f"{scene.stem}_sheet.png")
    images = []
    with rendering.replacing(output) as unfinished, progress("Rendering") as report:
        for image in frames(loaded, count, degrees, spp):
            images.append(image)
            report(len(images) / count)
        mi.Bitmap(contact_sheet(images)).write(str(unfinished))
    click.echo(output)


# --------------------------------------------------------------------------------------------------
#  Separated light
# --------------------------------------------------------------------------------------------------


def parts(scene: mi.Scene, spp: int | None) -> list[np.ndarray]:
    """The four pictures, (H, W, 3), linear."""
    with progress("Rendering") as report:
        layers = rendering.render(scene, spp, report=lambda done: report(done / 2))
        whole = rendering.render(
            scene, spp, report=lambda done: report(0.5 + done / 2), denoise=True
        )
    layers = {name: np.array(layer) for name, layer in layers.split()}
    direct, whole = layers["direct"], np.array(whole)[..., :3]
    return [direct, layers["indirect"], whole - direct, whole]


def two_by_two(images: list[np.ndarray]) -> mi.Bitmap:
    """Two rows of two pictures, 8-bit sRGB."""
    linear = np.vstack([np.hstack(images[:2]), np.hstack(images[2:])]).astype(np.float32)
    return mi.Bitmap(linear).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)


@sheet_options
@sheets.command()
def separated(
    scene: Path, output: Path | None, spp: int | None, define: dict[str, str], variant: str
) -> None:
    """Direct light, indirect light, indirect light denoised, and all together, on one sheet.

    For scenes whose integrator is ``glint_path`` with ``separate`` light. The last picture is that
    of ``glintbsdf render --denoise``; direct light is the same in all, bit for bit.
    """
    mi.set_variant(variant)
    loaded = rendering.load_scene(scene, define)
    if not getattr(loaded.integrator(), "separate", False):
        raise click.UsageError('the scene\'s integrator must be "glint_path" with "separate" on')
    output = output or Path(f"{scene.stem}_separated.png")
    with rendering.replacing(output) as unfinished:
        two_by_two(parts(loaded, spp)).write(str(unfinished))
    click.echo(output)


if __name__ == "__main__":
    sheets()
