"""Denoising of indirect light only: glints are direct light, and are never smoothed away.

The integrator :mod:`glint_path <glintbsdf.plugins.glint_path>` separates the two. Indirect light is
smooth but noisy (Tan et al. 2022, section 4), and Intel Open Image Denoise, through the package
``mitsuba-oidn``, filters it. Its guides are the albedo and the normals of the visible surfaces,
which Mitsuba's integrator ``aov`` renders along with the image.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import mitsuba as mi
import numpy as np

#: Names of the images that the integrator of :func:`guided` renders.
NAME, ALBEDO, NORMAL = "glints", "albedo", "normal"


@contextmanager
def guided(integrator: mi.Integrator) -> Iterator[mi.Integrator]:
    """Yield an integrator that renders the same image as ``integrator``, with direct and indirect
    light in separate channels, and the guides in further ones.

    Raises:
        ValueError: ``integrator`` is not a ``glint_path``.
        ModuleNotFoundError: no denoiser is installed; the message has the command to install one.
    """
    if not hasattr(integrator, "separate"):
        raise ValueError(
            'denoising needs the integrator "glint_path", which tells indirect light from direct '
            f"light (got {integrator.class_name()})"
        )
    if importlib.util.find_spec("mitsuba_oidn") is None:
        raise ModuleNotFoundError(
            "denoising needs Intel Open Image Denoise; install it with: "
            f"{sys.executable} -m pip install mitsuba-oidn"
        )
    before, integrator.separate = integrator.separate, True
    try:
        aovs = f"{ALBEDO}:albedo,{NORMAL}:sh_normal"
        yield mi.load_dict({"type": "aov", "aovs": aovs, NAME: integrator})
    finally:
        integrator.separate = before


def denoised(bitmap: mi.Bitmap) -> mi.Bitmap:
    """Denoise the indirect light of an image from the integrator of :func:`guided`.

    Red, green and blue are the direct light, unchanged, plus the denoised indirect light. There is
    an alpha channel if ``bitmap`` has one.
    """
    layers = {name: np.array(layer, np.float32) for name, layer in bitmap.split()}
    direct, indirect = (layers[f"{NAME}.{part}"] for part in ("direct", "indirect"))
    pixels = direct + denoise(indirect, layers[ALBEDO], layers[NORMAL])
    root = layers["<root>"]
    if root.shape[-1] == 4:
        pixels = np.concatenate([pixels, root[..., 3:]], axis=-1)
    return mi.Bitmap(pixels)


def denoise(radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Filter an image.

    Args:
        radiance: (H, W, 3) float32, linear, of any range; negative values count as 0.
        albedo: (H, W, 3) float32 in [0, 1].
        normal: (H, W, 3) float32, shading normals in [-1, 1].

    Returns:
        (H, W, 3) float32. Its mean may differ by a few per cent, as outliers are removed.
    """
    import mitsuba_oidn  # here: the import takes time, and the package may not be installed

    return np.asarray(mitsuba_oidn.denoise(radiance, albedo=albedo, normal=normal, hdr=True))
