"""Errors of images at equal time: ``glint_path`` against sampling alone on the same model.

The scene is a ball with a map of bumps, under four spherical lights, from nearly a point to a
softbox, or under a studio. Footprints have from 1 to 60 texels per pixel. *Sampling alone* is
``path`` with footprints of no size: it sees single elements, as Mitsuba's own integrators see the
texels of a normal map. Its mean is the truth, whose own noise is measured and subtracted.
``roughconductor`` has the roughness of the whole map. There is no masking: that of a footprint is
not the mean of that of its points.

Errors are over the contrast of the truth, its standard deviation over the pixels. *Robust* leaves
out the thousandth of the pixels with the largest errors. *Bias* is the error without the noise of
the samples, *deviation* this noise. *Factor* is the squared error that sampling alone has after the
same time, over that of the row; an error below a tenth of the truth's noise counts as this. *To
reach* are the seconds until the error is a tenth of the contrast, at the rate of the row. With
``-o``, ``convergence.csv`` has the rows of 16 samples per pixel.

Expected before measuring: the smaller the light and the larger the footprint, the larger the
factor; hundreds under a sun, a few under a softbox; about 1 under the studio, whose light comes
from everywhere, and under footprints of a texel.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np

from benchmarks.cases import SCENES, Surface, picture_of
from benchmarks.harness import Run, family, timed
from benchmarks.methods import METHODS, Method, rough
from benchmarks.report import figures
from benchmarks.report.output import write_csv
from glintbsdf import maps
from glintbsdf.check.truth import Truth, reference_render

#: Angular radii of the lights, radians; None is the studio.
LIGHTS = {"point": 5e-4, "sun": 5e-3, "lamp": 0.04, "softbox": 0.2, "studio": None}
DIRECTIONS = (0.5, 0.6, 1.0), (-0.7, 0.3, 1.0), (0.2, -0.6, 1.0), (-0.2, 0.1, 1.0)

#: Distances of camera and lights from the ball's centre, and the field of view (degrees).
CAMERA, FAR, FIELD_OF_VIEW = 5.0, 8.0, 14.0

#: Side of images, pixels, and of the map, texels. Footprints of no size: pixels of so many radians.
SIZE, TEXELS, NOTHING = 64, 512, 1e-9

#: Samples per pixel of sampling alone, where its error is measured; the error that is to reach.
ALONE, REACHED = 64, 0.1

#: Errors below this share of the truth's noise cannot be told.
LEAST = 0.1

#: Samples per pixel of ``glint_path``, and the methods of ``--quick``.
BUDGETS = 1, 4, 16, 64, 256
QUICK = "elements, step 0.5", "manifold, tables, max_error 0.05", "filter, lean"


def lights(light: str) -> dict:
    """Emitters, all of the same power."""
    radius = LIGHTS[light]
    if radius is None:
        return {"studio": {"type": "envmap", "filename": str(SCENES / "studio.exr")}}
    radiance = float(1 / (np.pi * np.sin(radius) ** 2))
    return {
        f"light {k}": {
            "type": "sphere",
            "center": (np.array(d) / np.linalg.norm(d) * FAR).tolist(),
            "radius": FAR * float(np.sin(radius)),
            "emitter": {"type": "area", "radiance": radiance},
        }
        for k, d in enumerate(DIRECTIONS)
    }


def repeated(texels: float, size: int = SIZE) -> mi.ScalarTransform4f:
    """The ``to_uv`` for ``texels`` per pixel in the middle of images of ``size``² pixels."""
    pixel = 2 * (CAMERA - 1) * np.tan(np.radians(FIELD_OF_VIEW / 2)) / size
    around = texels / pixel * 2 * np.pi / TEXELS  # maps around the ball, whose seam is not seen
    return mi.ScalarTransform4f().scale([around, around / 2, 1])


def ball(bsdf: dict, light: str, size: int = SIZE) -> mi.Scene:
    """The scene for images of ``size``² pixels."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    shape = {"type": "sphere", "to_world": turned, "bsdf": bsdf}
    return picture_of(shape, [0, 0, CAMERA], [0, 1, 0], FIELD_OF_VIEW, size, lights(light),
                      rfilter="gaussian")  # fmt: skip


def errors(scene: mi.Scene, integrator: str, spp: int, truth: Truth, seeds: int) -> dict:
    """The row of ``spp`` samples per pixel, without the factor."""
    used = mi.load_dict({"type": integrator, "max_depth": 2})
    frames = [timed(partial(mi.render, scene, integrator=used, spp=spp, seed=k))
              for k in range(seeds + 1)][1:]  # fmt: skip  # the first one compiles
    images = np.array([np.array(image)[..., :3] for image, _ in frames], np.float64)
    noise, contrast = truth.standard_error**2, truth.image.std()
    squared = (((images - truth.image) ** 2).mean(0) - noise).mean(2)
    variance = images.var(0, ddof=1).mean(2)
    usual = squared[squared <= np.quantile(squared, 0.999)]

    def root(square: np.ndarray) -> float:
        return float(np.sqrt(max(square.mean(), 0)) / contrast)

    return {
        "seconds": float(np.median([seconds for _, seconds in frames])),
        "error": root(squared),
        "robust": root(usual),
        "bias": root(squared - variance),
        "deviation": root(variance),
        "mean": float(images.mean() / truth.image.mean()),
    }


def measured(
    method: Method, surface: Surface, light: str, texels: float, quick: bool
) -> list[dict]:
    """All rows of a method under a light."""
    seeds, spp, budgets = (3, 8192, (4, 16, 64)) if quick else (5, 32768, BUDGETS)
    to_uv = repeated(texels)
    bsdf = {**method.describe(surface), "masking": "none", "to_uv": to_uv}
    alone = ball({**bsdf, "pixel_spread": NOTHING}, light)
    truth = reference_render(alone, spp)
    by_chance = errors(alone, "path", ALONE, truth, seeds)
    rows = [{"by": "sampling alone", "spp": ALONE, **by_chance}]
    for by, integrator, material in (
        ("glint_path", "glint_path", bsdf),
        ("roughconductor", "path", rough(surface.normal_map, to_uv)),
    ):
        scene = ball(material, light)
        for n in budgets if by == "glint_path" else budgets[-1:]:
            rows.append({"by": by, "spp": n, **errors(scene, integrator, n, truth, seeds)})
    work = by_chance["error"] ** 2 * by_chance["seconds"]
    noise = float(truth.noise / truth.image.std())
    for row in rows:
        reached = row["by"] == "sampling alone" or row["error"] <= REACHED
        row["factor"] = work / (row["seconds"] * max(row["error"], LEAST * noise) ** 2)
        row["to_reach"] = row["seconds"] * (row["error"] / REACHED) ** 2 if reached else None
        row["noise_of_truth"] = noise
    return rows


def lit(run: Run) -> None:
    """Errors and factors by light, texels per pixel, method and samples per pixel."""
    surface = Surface("bumps", maps.isotropic(TEXELS, alpha=0.16, correlation_length=6, seed=11))
    # LEADR is its masking
    compared = [m for m in METHODS if m.image and m.mapped and m.setting != "leadr"]
    compared = [m for m in compared if m.name in QUICK] if run.quick else compared
    with run.table("images") as table:
        for light in LIGHTS:
            for texels in (1, 14, 60):
                for method in compared:
                    key = {"light": light, "texels": texels, "method": method.name}
                    table.measure(key, partial(measured, method, surface, light, texels, run.quick))
    if run.output is None or not table.rows:
        return
    shown = [row for row in table.rows if row["texels"] == 14]
    figures.draw(run.output, "convergence", figures.convergence, shown or table.rows)
    write_csv(run.output / "convergence.csv", [
        {key: row[key] for key in ("light", "texels", "method")}
        | {"error": f"{row['error']:.1%}", "bias": f"{row['bias']:.1%}",
           "factor": f"{row['factor']:{'.0f' if row['factor'] >= 10 else '.2g'}}"}
        for row in table.rows if (row["by"], row["spp"]) == ("glint_path", 16)
    ])  # fmt: skip


convergence = family("convergence", lit)
