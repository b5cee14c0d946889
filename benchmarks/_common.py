"""What benchmarks share: times taken in turn, tables of pictures, results with what made them."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf


def seconds(work: Callable, *arguments) -> float:
    """Wall-clock time until what ``work(*arguments)`` returns is evaluated."""
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(work(*arguments))
    dr.sync_thread()
    return time.perf_counter() - start


def seconds_in_turn(works: Sequence[Callable], repetitions: int) -> np.ndarray:
    """Times (repetitions, works): all in turn within each repetition, so that ratios can be taken
    within it. Every work is called with the repetition's number, from 1: a seed.

    The first call of a work compiles; it has been made before.
    """
    return np.array([[seconds(work, k) for work in works] for k in range(1, repetitions + 1)])


def ratios_to_first(times: np.ndarray) -> np.ndarray:
    """Median over repetitions of the ratio of each work to the first one within the repetition."""
    return np.median(times / times[:, :1], axis=0)


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square difference."""
    return float(np.sqrt(np.mean((image - reference) ** 2)))


def save_pictures(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write a table of pictures of equal size, each (H, W) or (H, W, 3), linear."""
    cells = [[np.broadcast_to(np.atleast_3d(x), (*x.shape[:2], 3)) for x in row] for row in rows]
    table = np.concatenate([np.concatenate(row, 1) for row in cells], 0).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(table).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(str(path))


def save_results(path: Path, results: dict) -> None:
    """Write JSON: the versions and the machine that made the results, and these."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made_with = {
        "glintbsdf": glintbsdf.__version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": list(dr.detail.llvm_version()),
        "machine": platform.processor() or platform.machine(),
        "threads": dr.thread_count(),
    }
    path.write_text(json.dumps(made_with | results, indent=1) + "\n")
