"""Measured units on disk, so that a report which was interrupted goes on where it stopped.

A unit is one file, named after a hash of all that decides its content: what is measured and how,
the machine, the versions, and the source code of the package. A file appears whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf
from glintbsdf.scene.rendering import replacing

_ROOT = Path(__file__).parents[2]
_TEXT = "__json__"

#: Source on which the figures depend: folders, and modules of the benchmarks.
_MEASURED = ("src/glintbsdf", "plugins")
_MEASURING = (
    "_common",
    "curved_patch",
    *(f"report/{m}" for m in ("methods", "pndf", "images", "grid")),
)


class Store:
    """Units in a folder, for one ``context``: whatever all of them depend on."""

    def __init__(self, folder: Path, context: dict) -> None:
        self.folder, self.context = folder, context
        folder.mkdir(parents=True, exist_ok=True)

    def path(self, key: dict) -> Path:
        text = json.dumps([self.context, key], sort_keys=True, default=str)
        return self.folder / f"{hashlib.blake2b(text.encode(), digest_size=12).hexdigest()}.npz"

    def __contains__(self, key: dict) -> bool:
        return self.path(key).exists()

    def get(self, key: dict, measure: Callable[[], tuple[dict, dict[str, np.ndarray]]]):
        """``(values, arrays)`` of a unit: stored, or measured now and stored."""
        path = self.path(key)
        if not path.exists():
            values, arrays = measure()
            text = np.array(json.dumps(values))
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **{_TEXT: text}, **arrays)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return json.loads(str(arrays.pop(_TEXT))), arrays


def machine() -> dict:
    """What the figures were measured on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": dr.thread_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
        "numpy": np.__version__,
        "scipy": version("scipy"),
        "variant": mi.variant(),
        "glintbsdf": glintbsdf.__version__,
        "commit": _commit(),
        "source": source_hash(),
    }


def source_hash() -> str:
    """A hash of the package's own source, and of what of the benchmarks measures."""
    paths = [path for folder in _MEASURED for path in sorted((_ROOT / folder).rglob("*.py"))]
    paths += [_ROOT / "benchmarks" / f"{name}.py" for name in _MEASURING]
    digest = hashlib.blake2b(digest_size=8)
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _processor() -> str:
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit that is checked out, with a + where files have changed since; None outside git."""
    try:
        command = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty=+"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
