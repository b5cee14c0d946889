"""``glintbsdf doctor``: a report on the installation, and how to complete it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf import __version__
from glintbsdf.bridge import llvm

_PACKAGES = (
    "numpy",
    "scipy",
    "OpenEXR",
    "scikit-image",
    "matplotlib",
    "tifffile",
    "click",
    "rich",
    "platformdirs",
    "filelock",
)

#: Packages that only some users need, and the features that need them.
_OPTIONAL = {"mitsuba-oidn": "render --denoise", "distributed": "--workers and --scheduler"}

# One kernel per variant, in a separate process, as a backend that does not work may abort it.
_PROBE = """
import sys
import glintbsdf, drjit as dr, mitsuba as mi
for name in sys.argv[1:]:
    mi.set_variant(name)
    assert dr.all(dr.minimum(dr.arange(mi.Float, 3) + 1, 2) == mi.Float(1, 2, 2))
    print(name, flush=True)
"""


class Finding(NamedTuple):
    """One line of the report.

    ``remedy`` is the exact command that helps, if something is missing; ``fatal`` says whether
    nothing can be rendered without it.
    """

    name: str
    value: str
    remedy: str = ""
    fatal: bool = False


def examine() -> list[Finding]:
    """Examine this installation. This takes a few seconds, as every JIT variant runs a kernel."""
    return [
        Finding("glintbsdf", __version__),
        Finding("Python", f"{platform.python_version()} ({sys.executable})"),
        Finding("System", f"{platform.system()} {platform.machine()}"),
        Finding("Mitsuba", str(mi.__version__)),
        Finding("Dr.Jit", dr.__version__),  # type: ignore[attr-defined]  # its stubs lack it
        *map(_package, _PACKAGES),
        *(_package(name, use) for name, use in _OPTIONAL.items()),
        *_llvm(),
        _cuda(),
        _threads(),
        _variants(),
    ]


def _package(name: str, use: str = "") -> Finding:
    """Whether a package is installed. ``use`` is the feature that needs it, or empty if it is
    always needed."""
    try:
        return Finding(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        value = "missing" + (f" (optional: for {use})" if use else "")
        return Finding(name, value, f"{sys.executable} -m pip install {name}", fatal=not use)


def _llvm() -> list[Finding]:
    found = ", ".join(
        f"{'.'.join(map(str, library.version))} ({library.path})" for library in llvm.find()
    )
    version = llvm.loaded_version()
    loaded = "none" if version is None else ".".join(map(str, version))
    if path := os.environ.get(llvm.VARIABLE):
        loaded += f" ({llvm.VARIABLE}={path})"
    remedy = ""
    try:
        llvm.require_usable()
    except llvm.LLVMError as error:
        remedy = str(error)
    return [Finding("LLVM found", found or "none"), Finding("LLVM in use", loaded, remedy)]


def _cuda() -> Finding:
    if not dr.has_backend(dr.JitBackend.CUDA):
        return Finding("CUDA", "none (optional: needs an NVIDIA GPU and its driver)")
    driver = ".".join(map(str, dr.detail.cuda_version()))
    capability = dr.detail.cuda_compute_capability()
    return Finding("CUDA", f"driver {driver}, compute capability {capability}")


def _threads() -> Finding:
    count = dr.thread_count()
    remedy = ""
    if count < 2:
        remedy = (
            "With one thread, Mitsuba hangs when it reads OpenEXR files. The command line uses "
            "two; in Python, type: drjit.set_thread_count(2)"
        )
    return Finding("Threads", str(count), remedy)


def _variants() -> Finding:
    running, problem = [], ""
    for backend in (dr.JitBackend.LLVM, dr.JitBackend.CUDA):
        if not dr.has_backend(backend):
            continue
        prefix = f"{backend.name.lower()}_"
        names = [name for name in mi.variants() if name.startswith(prefix)]
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE, *names], capture_output=True, text=True, check=False
        )
        # The variants before the first failure were printed; mostly a backend runs all or none.
        running += probe.stdout.split()
        if probe.returncode != 0:
            problem = (probe.stderr.strip() or f"exit status {probe.returncode}").splitlines()[-1]
    return Finding("Variants that run", ", ".join(running) or "none", problem, not running)
