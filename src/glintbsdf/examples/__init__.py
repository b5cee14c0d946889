"""Small scenes that come with the package: ``glintbsdf example`` copies them out.

A scene file is stored as it is. Its normal map and its mesh are made from a formula and a fixed
seed when the example is copied, as that takes less room than storing them.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

SCENE = "scene.xml"


@dataclass(frozen=True)
class Example:
    """A scene that comes with the package.

    Attributes:
        name (str): its name, which is also its folder's.
        title (str): what it shows, one sentence.
        made (dict): functions that write the files besides the scene, by the name of the file.
    """

    name: str
    title: str
    made: Mapping[str, Callable[[Path], None]] = field(default_factory=dict, repr=False)

    def copy(self, folder: str | Path) -> list[Path]:
        """Write the scene and its files to a folder, which must not exist or be empty.

        Returns the files, the scene first. Any variant of Mitsuba must be active.

        Raises:
            FileExistsError: the folder has something in it, or is a file.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(
                f"{folder} exists and is not an empty folder: choose another (-o)"
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        # The folder appears when all of its files are there.
        unfinished = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
        try:
            os.chmod(unfinished, 0o777 & ~_umask())
            shutil.copyfile(Path(__file__).parent / self.name / SCENE, unfinished / SCENE)
            for name, make in self.made.items():
                make(unfinished / name)
            if folder.exists():
                folder.rmdir()
            unfinished.rename(folder)
        except BaseException:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
        return [folder / name for name in (SCENE, *self.made)]


def _umask() -> int:
    """The process's mask of permissions, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


# --------------------------------------------------------------------------------------------------
#  Files that are made
# --------------------------------------------------------------------------------------------------


def _scratched_map(path: Path) -> None:
    """An OpenEXR with the projected normals of scratched steel in its channels R and G."""
    import mitsuba as mi

    from glintbsdf.maps import procedural

    normals = procedural.scratched(
        512, coverage=0.5, length=400.0, width=3.0, slope=0.5, alpha=0.12, seed=3
    ).normals
    colours = np.concatenate([normals, np.ones_like(normals[..., :1])], axis=2)
    # Two of three channels say all, but programs that show images want three.
    colours[..., 2] = np.sqrt(1 - (normals**2).sum(axis=2))
    half = mi.Bitmap(colours).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float16, False)
    half.write(str(path))


def _brushed_png(path: Path) -> None:
    """A normal map as painting programs export it: PNG, 16 bits, green up (OpenGL)."""
    import mitsuba as mi

    from glintbsdf.maps import procedural

    normals = procedural.brushed(1024, alpha=0.35, streak_length=12, streak_width=3, seed=5).normals
    x, y = normals[..., 0], -normals[..., 1]  # up is against the rows
    colours = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=2)
    values = np.rint((0.5 + 0.5 * colours) * 65535).astype(np.uint16)
    mi.Bitmap(values, mi.Bitmap.PixelFormat.RGB).write(str(path))


#: Radii of the vase at equal steps of its height, from the foot to the rim.
PROFILE = (0.30, 0.34, 0.46, 0.56, 0.58, 0.52, 0.40, 0.29, 0.24, 0.25, 0.32)
HEIGHT = 1.6


def _vase(path: Path, around: int = 96, along: int = 96) -> None:
    """A surface of revolution as an OBJ with normals and UVs: u around, v up the vase."""
    from scipy.interpolate import CubicSpline

    steps = np.linspace(0, 1, len(PROFILE))
    radius, slope = CubicSpline(steps, PROFILE), CubicSpline(steps, PROFILE).derivative()
    v, u = np.meshgrid(np.linspace(0, 1, along + 1), np.linspace(0, 1, around + 1), indexing="ij")
    sine, cosine = np.sin(2 * np.pi * u), np.cos(2 * np.pi * u)
    places = np.stack([radius(v) * cosine, HEIGHT * v, -radius(v) * sine], axis=-1)
    normals = np.stack([cosine * HEIGHT, -slope(v), -sine * HEIGHT], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lines = ["# A vase", "o vase"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in places.reshape(-1, 3)]
    lines += [f"vt {a:.6f} {b:.6f}" for a, b in np.stack([u, v], axis=-1).reshape(-1, 2)]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals.reshape(-1, 3)]
    row = around + 1
    for j in range(along):
        for i in range(around):
            corner = 1 + j * row + i
            corners = (corner, corner + 1, corner + 1 + row, corner + row)
            lines.append("f " + " ".join(f"{c}/{c}/{c}" for c in corners))
    path.write_text("\n".join(lines) + "\n")


#: All examples, by name.
EXAMPLES: Mapping[str, Example] = {
    example.name: example
    for example in (
        Example(
            "scratched",
            "A scratched ball of steel on a scratched plate: glint_manifold on a normal map.",
            {"scratched.exr": _scratched_map},
        ),
        Example(
            "glitter",
            "A glittering ball without any map: glint_grid with coloured microdetails.",
        ),
        Example(
            "vase",
            "An OBJ with a PNG normal map from a painting program: glint_manifold on a vase.",
            {"vase.obj": _vase, "brushed.png": _brushed_png},
        ),
    )
}
