"""What stands before the first picture: loading, memory, kernels, compiling, for every plugin.

Each case runs in two processes of its own. The first finds empty caches, the second finds what the
first has left there. Mitsuba's ``bitmap``, ``normalmap`` and ``roughconductor`` with the same map
are the measure.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from math import radians
from pathlib import Path

import click
import mitsuba as mi
import numpy as np

from benchmarks.harness import Run, family
from glintbsdf import maps

STOCK = "bitmap, normalmap, roughconductor"

#: Settings by the name in the table. The others have the defaults.
PLUGINS = {
    STOCK: {"type": "normalmap"},
    "glint_manifold": {"type": "glint_manifold"},
    "glint_manifold, tables": {"type": "glint_manifold", "max_error": 0.05},
    "glint_elements": {"type": "glint_elements"},
    "glint_filtered": {"type": "glint_filtered"},
    "glint_diffuse": {"type": "glint_diffuse"},
    "glint_mip": {"type": "glint_mip"},
    "glint_grid": {"type": "glint_grid"},
    "glint_particles": {"type": "glint_particles"},
}

#: Plugins without a map, and the one that needs a sample only, of this side.
WITHOUT_MAP, SAMPLE = ("glint_grid", "glint_particles"), 256

#: Sides of the maps, and of the image.
SIZES, PIXELS = (1024, 2048, 4096, 8192), 64


def material(plugin: dict, file: Path) -> dict:
    """The dictionary of a BSDF with the map in a file."""
    if plugin["type"] != "normalmap":
        plugin = plugin | {"pixel_spread": radians(45) / PIXELS}
    if plugin["type"] in WITHOUT_MAP:
        return plugin
    normals = np.load(file)
    if plugin["type"] == "normalmap":
        z = np.sqrt(1 - np.einsum("ijk,ijk->ij", normals, normals))[..., None]
        bitmap = mi.Bitmap(np.concatenate([0.5 * normals + 0.5, 0.5 * z + 0.5], axis=2))
        texture = {"type": "bitmap", "bitmap": bitmap, "raw": True}
        return plugin | {"normalmap": texture, "nested": {"type": "roughconductor"}}
    if plugin["type"] == "glint_mip":
        normals = np.ascontiguousarray(normals[:SAMPLE, :SAMPLE])
    return plugin | {"data": mi.TensorXf(normals), "flip_y": False}


def memory() -> tuple[float, float]:
    """The largest and the present memory of this process, GiB."""
    if sys.platform == "linux":
        # What getrusage() returns as the largest is that of the process that started this one.
        status = Path("/proc/self/status").read_text()
        kib = {line.split()[0]: line.split()[1] for line in status.splitlines() if "kB" in line}
        return int(kib["VmHWM:"]) / 2**20, int(kib["VmRSS:"]) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**30, 0.0


def child(variant: str, plugin: dict, file: Path) -> dict:
    """Measure a case; processor time is of all threads."""
    import drjit as dr

    mi.set_variant(variant)
    from benchmarks.cases import curved_patch

    description = material(plugin, file)
    start, cpu = time.perf_counter(), time.process_time()
    scene = curved_patch(description, PIXELS, 4)
    dr.sync_thread()
    load, cpu = time.perf_counter() - start, time.process_time() - cpu
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        dr.eval(mi.render(scene))
        dr.sync_thread()
        frame = time.perf_counter() - start
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    compiling = sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
    peak, resident = memory()
    return {"load": load, "load_cpu": cpu, "frame": frame, "kernels": len(kernels),
            "compiling": compiling, "operations": max(k["operation_count"] for k in kernels),
            "peak": peak, "resident": resident}  # fmt: skip


def measured(name: str, size: int, variant: str, stock: dict | None) -> dict:
    """A row: a case with cold and with warm caches, and ratios to ``stock``, a row like it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "normals.npy"
        if name not in WITHOUT_MAP:
            np.save(file, maps.isotropic(size, alpha=0.1).normals)
        caches = {"GLINTBSDF_CACHE": f"{folder}/structures", "DRJIT_CACHE_DIR": f"{folder}/kernels"}
        code = "import glintbsdf; from benchmarks.commands.front import main; main()"
        command = [sys.executable, "-c", code, variant, json.dumps(PLUGINS[name]), str(file)]
        rows = []
        for _ in range(2):
            done = subprocess.run(command, capture_output=True, text=True, env=os.environ | caches)
            if done.returncode != 0:
                raise click.ClickException(f"{name}, {size}: {done.stderr.strip()[-500:]}")
            rows.append(json.loads(done.stdout[done.stdout.rindex("{") :]))  # after any messages
    cold, warm = rows
    row = cold | {"load_warm": warm["load"], "frame_warm": warm["frame"]}
    if stock is not None:
        row |= {f"{key}_ratio": row[key] / stock[key] for key in ("load", "frame", "resident")}
    return row


def plugins(run: Run) -> None:
    """Seconds to load, with cold and warm caches; peak and resident memory of the process (GiB);
    kernels, seconds to compile them and operations of the largest; seconds of the first frame.

    The scene is the curved patch, 64² pixels, and the map an isotropic one. Memory includes
    Mitsuba's own and the map that was handed over. Ratios are to Mitsuba's own material with a map
    of the same size. Expected: 1.5 s and 12 s to load 1024² and 4096² on two idle cores, 0.3 s and
    2 s from the cache; at most 2.5 GiB at 4096², of which 1.5 GiB stay, and 8 GiB at 8192².
    """
    variant = mi.variant()
    names = [STOCK, "glint_manifold", "glint_filtered"] if run.quick else PLUGINS
    with run.table("plugins") as table:
        for size in (128,) if run.quick else SIZES:
            stock = None
            for name in names:
                constant = name in (*WITHOUT_MAP, "glint_mip")
                if constant and size > SIZES[0]:
                    continue
                work = partial(measured, name, size, variant, stock)
                rows = table.measure({"plugin": name, "size": size}, work)
                stock = rows[0] if name == STOCK and rows else stock


def main() -> None:
    """The process of a case: its arguments are those of :func:`child`, a JSON is its output."""
    variant, plugin, file = sys.argv[1:]
    print(json.dumps(child(variant, json.loads(plugin), Path(file))))


front = family("front", plugins)
