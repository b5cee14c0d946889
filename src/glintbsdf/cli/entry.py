"""The command line: ``render``, ``sequence``, ``example``, ``pndf``, ``inspect``, ``synthesise``
and ``doctor``.

This module has only the parts that concern the terminal; other modules do the work.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any, NoReturn

import click
import drjit as dr
import mitsuba as mi

from glintbsdf import __version__
from glintbsdf.bridge import llvm
from glintbsdf.cli.doctor import examine
from glintbsdf.cli.render_options import (
    ImageRequest,
    RenderOptions,
    check_image,
    image_option,
    render_to_file,
    replaces_integrator,
)
from glintbsdf.cli.render_options import options as render_options
from glintbsdf.core.errors import one_line
from glintbsdf.core.interruption import interruptible
from glintbsdf.core.progress import progress
from glintbsdf.examples import EXAMPLES
from glintbsdf.maps.normalmap import MAP_TYPES, WRAP_MODES, NormalMap
from glintbsdf.scene import inspection, rendering
from glintbsdf.scene import sequence as frames

Definitions = tuple[str, ...]

DEFAULT_VARIANT = "llvm_ad_rgb"


def main() -> NoReturn:
    """Run the command line. Errors are one line on stderr; ``--debug`` shows the traceback.

    The exit status is 0 for success, 1 for a failure, 2 for wrong usage.
    """
    debug = "--debug" in sys.argv[1:]
    try:
        with interruptible():
            status = commands.main(prog_name="glintbsdf", standalone_mode=False)
        sys.exit(status if isinstance(status, int) else 0)
    except (click.Abort, KeyboardInterrupt):
        sys.exit("Aborted.")
    except click.ClickException as error:
        click.echo(f"Error: {one_line(error.format_message())}", err=True)
        sys.exit(error.exit_code)
    except Exception as error:
        if debug:
            raise
        sys.exit(f"Error: {one_line(str(error)) or type(error).__name__}")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="glintbsdf")
@click.option("--debug", is_flag=True, help="Show the Python traceback of an error.")
def commands(debug: bool) -> None:
    """Glint BSDFs for Mitsuba 3."""


# ---------------------------------------------------------------------------------------------
#  Options that commands share
# ---------------------------------------------------------------------------------------------


def _activate(variant: str) -> None:
    """Choose a Mitsuba variant. If it cannot run, raise before Dr.Jit can abort the process."""
    known = [name for name in mi.variants() if not name.startswith("scalar")]
    if variant not in known:
        raise click.BadParameter(
            f'must be one of {", ".join(known)} (got "{variant}")', param_hint="-m"
        )
    if variant.startswith("llvm"):
        llvm.require_usable()
    elif not dr.has_backend(dr.JitBackend.CUDA):
        raise click.ClickException(
            f"{variant} needs an NVIDIA GPU and its driver, and Dr.Jit finds none. "
            f"On the CPU: -m {DEFAULT_VARIANT}"
        )
    mi.set_variant(variant)


def _parse_definitions(
    _context: click.Context, _parameter: click.Parameter, values: Definitions
) -> dict[str, str]:
    """A dictionary of strings, from ``("a=1", "b=2")``."""
    pairs = [value.partition("=") for value in values]
    for value, (key, equals, _) in zip(values, pairs, strict=True):
        if not key or not equals:
            raise click.BadParameter(f'must be key=value (got "{value}")')
    return {key: value for key, _, value in pairs}


def _parse_exr(_context: click.Context, _parameter: click.Parameter, path: Path) -> Path:
    """Refuse names that are not names of OpenEXR files."""
    if path.suffix.lower() != ".exr":
        raise click.BadParameter(f'must end in .exr (got "{path}")')
    return path


def _parse_figure(_context: click.Context, _parameter: click.Parameter, path: Path) -> Path:
    """Refuse names of files that are neither figures nor archives of numbers."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg", ".npz"):
        raise click.BadParameter(f'must end in .png, .pdf, .svg or .npz (got "{path}")')
    return path


_variant_option = click.option(
    "-m",
    "variant",
    metavar="VARIANT",
    default=DEFAULT_VARIANT,
    show_default=True,
    help="Variant of Mitsuba.",
)
_file = click.Path(exists=True, dir_okay=False, path_type=Path)


def _refuse_same(output: Path, given: Path) -> None:
    """Refuse to overwrite the input file."""
    if output.exists() and output.samefile(given):
        raise click.BadParameter(f'must not be the map itself (got "{output}")', param_hint="-o")


def _define_option(meaning: str):
    return click.option(
        "-D",
        "definitions",
        metavar="KEY=VALUE",
        multiple=True,
        callback=_parse_definitions,
        help=meaning,
    )


_sensor_option = click.option(
    "-s",
    "sensor",
    default="",
    metavar="SENSOR",
    help="Sensor of the scene, by number from 0 or by id.  [default: the first]",
)


_keep_option = click.option(
    "--keep-integrator",
    is_flag=True,
    help='Keep the scene\'s integrator, where "glint_path" would take the place of "path" or '
    '"direct".',
)


def _image_options(command):
    """Add the options about the scene and its image that all rendering commands share."""
    for option in reversed(
        [
            _variant_option,
            _sensor_option,
            click.option(
                "--spp",
                type=click.IntRange(min=1),
                help="Samples per pixel.  [default: the scene's]",
            ),
            click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True),
            click.option(
                "--denoise",
                is_flag=True,
                help="Denoise the indirect light. Direct light, and with it all glints, stays as "
                'it is. Needs the integrator "glint_path".',
            ),
            click.option(
                "--trim",
                is_flag=True,
                help="Build only the parts of the maps' structures that the scene uses, which a "
                "survey with few samples finds. The image is the same.",
            ),
            _keep_option,
        ]
    ):
        command = option(command)
    return command


# ---------------------------------------------------------------------------------------------
#  Commands
# ---------------------------------------------------------------------------------------------


@commands.command()
@click.argument("scene", type=_file)
@image_option("-o", "output", help="Image to write, .exr or .png.  [default: SCENE.exr]")
@_image_options
@_define_option("Parameter of the scene; may be repeated.")
@render_options
def render(
    scene: Path,
    output: Path | None,
    variant: str,
    sensor: str,
    spp: int | None,
    seed: int,
    denoise: bool,
    trim: bool,
    keep_integrator: bool,
    definitions: dict[str, str],
    **how: Any,
) -> None:
    """Render the Mitsuba scene SCENE to an image.

    The integrator "glint_path" takes the place of "path" and "direct" in a scene with glint BSDFs.
    With others, glint BSDFs whose "pixel_spread" is 0 get the footprint of the camera's pixels. The
    same command gives the same image, to the last bit. If the rendering takes more than half a
    minute, the command first prints an estimate, and what would help. Ctrl-C keeps the finished
    passes.
    """
    options = RenderOptions(**how)
    _activate(variant)
    request = ImageRequest(
        scene, definitions, variant, spp, seed, denoise, trim, keep_integrator, sensor
    )
    with options.cluster(variant) as cluster:
        render_to_file(request, output or scene.with_suffix(".exr"), options, cluster)


@commands.command()
@click.argument("scene", type=_file)
@click.option(
    "-o",
    "template",
    metavar="NAMES",
    help="Images to write, .exr or .png. Fields such as {index} and {PARAMETER} are replaced by "
    "the values of a frame.  [default: SCENE_{index:04}.exr]",
)
@_image_options
@_define_option(
    "Parameter of the scene; may be repeated. first:last:count makes a frame for each of count "
    "evenly spaced values; several such ranges make a frame for each combination."
)
@click.option("--table", type=_file, help="CSV file of parameters, with a row for each frame.")
@click.option("--together", is_flag=True, help="All ranges advance together, frame by frame.")
@image_option(
    "--sheet",
    help="Contact sheet of all frames to write, .exr or .png. With two ranges, it has a row for "
    "each value of the first.",
)
@click.option(
    "--video",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Video of all frames to write, such as out.mp4. Needs ffmpeg.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0, min_open=True),
    default=24,
    show_default=True,
    help="Frames of the video per second.",
)
@render_options
def sequence(
    scene: Path,
    template: str | None,
    definitions: dict[str, str],
    table: Path | None,
    together: bool,
    sheet: Path | None,
    video: Path | None,
    rate: float,
    variant: str,
    sensor: str,
    spp: int | None,
    seed: int,
    denoise: bool,
    trim: bool,
    keep_integrator: bool,
    **how: Any,
) -> None:
    """Render frames of the Mitsuba scene SCENE, with different parameters.

    All frames draw the same random numbers. With --checkpoint, each frame has its own folder in
    DIR, and finished frames are not rendered again.
    """
    options = RenderOptions(**how)
    template = template or f"{scene.stem}_{{index:04}}.exr"
    check_image(Path(template))
    rows = frames.read_table(table) if table else []
    parameters = frames.frames_of(definitions, rows, together)
    names = frames.names_of(template, parameters)
    for output in (sheet, video):
        for values in parameters:
            request = ImageRequest(
                scene, values, variant, spp, seed, denoise, trim, keep_integrator
            )
            request.refuse_as_output(output)
    if video:
        frames.require_ffmpeg()
    _activate(variant)
    for folder in {name.parent for name in names}:
        folder.mkdir(parents=True, exist_ok=True)
    with options.cluster(variant) as cluster:
        for index, (values, name) in enumerate(zip(parameters, names, strict=True)):
            request = ImageRequest(
                scene, values, variant, spp, seed, denoise, trim, keep_integrator, sensor
            )
            label = f"Frame {index + 1} of {len(names)}"
            render_to_file(request, name, options.of_frame(index), cluster, label)
    if sheet:
        ranges = [v for v in map(frames.values_of, definitions.values()) if v]
        columns = len(ranges[-1]) if len(ranges) == 2 and not rows and not together else None
        with rendering.replacing(sheet) as unfinished:
            rendering.save(frames.sheet(names, columns), unfinished)
        click.echo(sheet)
    if video:
        frames.write_video(names, video, rate)
        click.echo(video)


@commands.command()
@click.argument("scene", type=_file)
@_variant_option
@_sensor_option
@click.option(
    "--spp",
    type=click.IntRange(min=1),
    help="Samples per pixel, on which footprints depend.  [default: the scene's]",
)
@_define_option("Parameter of the scene; may be repeated.")
@_keep_option
def inspect(
    scene: Path,
    variant: str,
    sensor: str,
    spp: int | None,
    definitions: dict[str, str],
    keep_integrator: bool,
) -> None:
    """Report how the Mitsuba scene SCENE uses its glint BSDFs, and what they build.

    For each BSDF: the part of its map and the sizes of footprints that paths of the scene's sensor
    and of the integrator of "render" use, at all bounces; the memory of its structures; and their
    memory with "render --trim".
    """
    _activate(variant)
    glint_path = replaces_integrator(scene, definitions, keep_integrator)
    inspected = inspection.load(scene, definitions, glint_path)
    with progress("Inspecting") as report:
        findings = inspection.inspect(inspected, spp, sensor, report)
    click.echo("\n\n".join(map(str, findings)) or "The scene has no glint BSDF.")


@commands.command()
@click.argument("name", required=False, type=click.Choice(list(EXAMPLES)), metavar="[NAME]")
@click.option(
    "-o",
    "folder",
    type=click.Path(path_type=Path),
    help="Folder to make.  [default: the example's name]",
)
def example(name: str | None, folder: Path | None) -> None:
    """Copy out the scene NAME with its files, or list the scenes that come with the package."""
    if name is None:
        width = max(map(len, EXAMPLES))
        for known in EXAMPLES.values():
            click.echo(f"{known.name:{width}}  {known.title}")
        return
    mi.set_variant("scalar_rgb")  # enough to write images
    scene, *files = EXAMPLES[name].copy(folder or name)
    for path in (scene, *files):
        click.echo(path)
    click.echo(f"glintbsdf render {shlex.quote(str(scene))} -o {name}.png", err=True)


@commands.command()
@click.option("--type", "plugin", required=True, metavar="TYPE", help="Type of the glint BSDF.")
@click.option("--map", "map_file", type=_file, help="Normal or height map, where TYPE takes one.")
@click.option("--uv", type=(float, float), required=True, help="Centre of the footprint.")
@click.option(
    "--sigma",
    type=click.FloatRange(min=0),
    required=True,
    help="Standard deviation of the footprint in texels of the map; in UV without a map.",
)
@click.option(
    "--res",
    type=click.IntRange(2, 4096),
    default=256,
    show_default=True,
    help="Bins of normals along each axis.",
)
@click.option(
    "-o",
    "output",
    type=click.Path(path_type=Path),
    callback=_parse_figure,
    default="pndf.png",
    show_default=True,
    help="Figure to write: .png, .pdf or .svg; or its numbers: .npz.",
)
@_variant_option
@_define_option("Parameter of the BSDF; may be repeated.")
def pndf(
    plugin: str,
    map_file: Path | None,
    uv: tuple[float, float],
    sigma: float,
    res: int,
    output: Path,
    variant: str,
    definitions: dict[str, str],
) -> None:
    """Draw a P-NDF beside its reference.

    The figure has the plugin's density over the disk of normals, a reference that counts samples of
    the map's normals, and the footprint on the map. Without a map, the reference counts normals
    that the plugin draws. The command prints the relative L1 difference, the difference that noise
    alone would make, what that means, and the time.
    """
    from glintbsdf.check import comparison, plot

    _activate(variant)
    if map_file is not None:
        _refuse_same(output, map_file)
    with rendering.replacing(output) as unfinished:
        compared = comparison.compare(plugin, map_file, uv, sigma, res, definitions)
        if output.suffix.lower() == ".npz":
            compared.save(unfinished)
        else:
            plot.pndf(compared).savefig(unfinished, dpi=120)
    click.echo(compared)
    click.echo(output)


@commands.command()
@click.argument("sample", type=_file)
@click.option(
    "-o",
    "output",
    type=click.Path(path_type=Path),
    callback=_parse_exr,
    required=True,
    help="Map to write, .exr.",
)
@click.option(
    "--output-size", type=int, default=4096, show_default=True, help="Width of the map, texels."
)
@click.option(
    "--patch-size", type=int, default=64, show_default=True, help="Width of a patch, texels."
)
@click.option(
    "--overlap", type=int, help="Overlap of patches, texels.  [default: a tenth of a patch]"
)
@click.option(
    "--balance",
    type=float,
    default=0.9,
    show_default=True,
    help="Weight of normals, relative to that of their Jacobians.",
)
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--wrap-mode",
    type=click.Choice(WRAP_MODES),
    default="repeat",
    show_default=True,
    help="With repeat, the opposite borders of the map fit together.",
)
@click.option("--map-type", type=click.Choice(MAP_TYPES), default="auto", show_default=True)
@click.option("--height-scale", type=float, default=1.0, show_default=True)
def synthesise(
    sample: Path,
    output: Path,
    wrap_mode: str,
    map_type: str,
    height_scale: float,
    **options: Any,
) -> None:
    """Make a large normal map from the small normal or height map SAMPLE.

    The result is the map of glint_mip with the same parameters. That plugin does not need the file.
    """
    from glintbsdf.maps.quilting import synthesise as make_map

    _refuse_same(output, sample)
    normal_map = NormalMap.load(sample, map_type, height_scale, wrap_mode, "synthesise")
    with rendering.replacing(output) as unfinished:
        made = make_map(normal_map, **options, toroidal=wrap_mode == "repeat")
        made.write(unfinished)
    click.echo(made)
    click.echo(output)


@commands.command()
@click.pass_context
def doctor(context: click.Context) -> None:
    """Report what is installed, what runs, and how to get what is missing."""
    findings = examine()
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        click.echo(f"{finding.name:<{width}}  {finding.value}")
        if finding.remedy:
            click.echo(f"{'':<{width}}  -> {finding.remedy}")
    context.exit(1 if any(finding.fatal for finding in findings) else 0)
