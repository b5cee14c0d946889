"""Options and fixtures of all tests: the variant, a clean Dr.Jit, and a separate cache."""

from __future__ import annotations

import gc
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

# Most of the time of the tests is LLVM's. "optimised" tests the kernels that users get.
os.environ.setdefault("GLINTBSDF_KERNELS", "quick")

import glintbsdf  # noqa: F401  (first: it names the LLVM library that Dr.Jit is to load)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from glintbsdf.core import tuning

# Besides the variant of the run: several wavelengths per ray, one channel, Mueller matrices.
OTHER_COLOURS = ("spectral", "mono", "spectral_polarized")

#: Folders of tests that compute more than they read and write.
COMPUTING = ("bridge", "check", "footprint", "lights", "microfacet", "plugins", "pndf")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--variant",
        default="llvm_ad_rgb",
        help="Mitsuba variant the tests run in (default: llvm_ad_rgb)",
    )


def pytest_collection_finish() -> None:
    # Modules and tests live to the end of the run. Garbage is collected after every test, and need
    # not be sought among them.
    gc.collect()
    gc.freeze()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "each_variant" in metafunc.fixturenames:
        backend = metafunc.config.getoption("--variant").split("_", 1)[0]
        variants = [f"{backend}_ad_{colour}" for colour in OTHER_COLOURS]
        metafunc.parametrize("each_variant", variants, indirect=True)


def _activate(name: str) -> str:
    """Choose the variant ``name``; skip the test if it is not compiled or has no device."""
    if name not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {name}")
    backend = dr.JitBackend.CUDA if name.startswith("cuda") else dr.JitBackend.LLVM
    if not name.startswith("scalar") and not dr.has_backend(backend):
        pytest.skip(f"no device for {name}")
    mi.set_variant(name)
    return name


@pytest.fixture
def tune(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Change constants, by name, in the tables of all backends, for one test."""

    def change(**values: float) -> None:
        for backend, table in tuning.TABLES.items():
            monkeypatch.setitem(tuning.TABLES, backend, replace(table, **values))

    return change


@pytest.fixture
def variant(request: pytest.FixtureRequest) -> str:
    """Activate the variant of the run (``--variant``) and return its name."""
    return _activate(request.config.getoption("--variant"))


@pytest.fixture
def each_variant(request: pytest.FixtureRequest) -> str:
    """Run a short test in a spectral, a monochromatic and a polarised variant."""
    return _activate(request.param)


@pytest.fixture
def told(variant: str, capfd: pytest.CaptureFixture[str]) -> Callable[[], list[str]]:
    """A function that returns the warnings in Mitsuba's log since its last call, one per line."""

    def since() -> list[str]:
        text = "".join(capfd.readouterr())
        return [line for line in text.splitlines() if re.search(r"\d WARN ", line)]

    return since


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the tests away from the user's cache of built structures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GLINTBSDF_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _one_thread(request: pytest.FixtureRequest) -> None:
    """With a process on each core, a second thread in each only takes time from the others.

    Mitsuba hangs when it reads or writes OpenEXR files with one thread.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = request.path.relative_to(Path(__file__).parent).parts[0]
        several = folder not in COMPUTING or request.node.get_closest_marker("openexr")
        dr.set_thread_count(2 if several else 1)


@pytest.fixture(autouse=True)
def _own_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods and modules of plugins that a test registers are known to no other test."""
    from glintbsdf.bridge import registration
    from glintbsdf.pndf import base

    monkeypatch.setattr(base, "_methods", base.methods())
    monkeypatch.setattr(registration, "_added", list(registration._added))


@pytest.fixture(autouse=True)
def _flush_drjit() -> Iterator[None]:
    """Free the memory of a test, so that it does not add up over a run."""
    yield
    if mi.variant() is not None and not mi.variant().startswith("scalar"):
        gc.collect()
        dr.flush_malloc_cache()


@pytest.fixture
def no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is told about time, which a busy machine would have among the errors."""
    monkeypatch.setattr("glintbsdf.core.progress._FIRST_LINE", 1e9)
    monkeypatch.setattr("glintbsdf.core.progress._LONG", 1e9)
    monkeypatch.setattr("glintbsdf.scene.estimation.LONG", 1e9)
