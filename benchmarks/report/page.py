"""The page: everything of the report in one file that needs no network. Needs Jinja2 and Pillow."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import jinja2
import matplotlib
import numpy as np
from PIL import Image

#: Brightness is this power of density: a few peaks would leave all else black.
_GAMMA = 0.5


def fill(template: str, **values: object) -> str:
    """A template of this folder with its values; what it lacks is an error."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(**values)


def html(report: dict, drawn: dict[str, str], thumbnails: dict[str, str], picture) -> str:
    """The page of a report.

    ``drawn`` are SVG texts by the names that ``picture`` gives them, ``thumbnails`` data URIs.
    """
    return fill(
        "page.html.jinja",
        report=report,
        figures={name: jinja2.utils.markupsafe.Markup(svg) for name, svg in drawn.items()},
        thumbnails=thumbnails,
        picture=picture,
    )


def density_uri(density: np.ndarray, peak: float) -> str:
    """A P-NDF, y upwards, in false colours; ``peak`` is white."""
    colours = matplotlib.colormaps["inferno"](np.clip(density[::-1] / peak, 0, 1) ** _GAMMA)
    return webp(colours[..., :3])


def white_of(image: np.ndarray) -> float:
    """The value shown as white: all but the brightest glints are below it."""
    return float(np.quantile(image, 0.995))


def image_uri(image: np.ndarray, white: float) -> str:
    """A render."""
    return data_uri(np.clip(image / white, 0, 1))


def data_uri(linear: np.ndarray) -> str:
    """An H×W×3 image of linear RGB in [0, 1], as WebP within a ``data:`` address."""
    return webp(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def webp(encoded: np.ndarray) -> str:
    """An H×W×3 image of sRGB in [0, 1], as WebP within a ``data:`` address."""
    buffer = io.BytesIO()
    Image.fromarray(np.uint8(np.rint(255 * encoded))).save(buffer, "WEBP", quality=85)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()
