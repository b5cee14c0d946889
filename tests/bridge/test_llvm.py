"""Search, choice and refusal of LLVM libraries."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from glintbsdf.bridge import llvm


def python(script: str, named: str | None = None) -> subprocess.CompletedProcess:
    """Run ``script`` in a fresh interpreter, with a library in the environment or without."""
    environment = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    if named is not None:
        environment[llvm.VARIABLE] = named
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, env=environment
    )


@pytest.fixture(scope="module")
def usable() -> llvm.Library:
    found = [library for library in llvm.find() if library.usable]
    if not found:
        pytest.skip("this machine has no usable LLVM")
    return found[0]


@pytest.fixture(scope="module")
def too_old() -> llvm.Library:
    found = [library for library in llvm.find() if not library.usable]
    if not found:
        pytest.skip("this machine has no LLVM older than 16")
    return found[0]


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so", (14, 0, 6)),
        ("libLLVM-15.so", (15,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.so.23.1", (23, 1)),
        ("libLLVM-18.dylib", (18,)),
    ],
)
def test_version_is_read_off_the_name(name, version):
    assert llvm._version(f"/nowhere/{name}") == version


def test_version_from_the_library_itself(usable):
    assert llvm._ask_version(usable.path)[: len(usable.version)] == usable.version


def test_library_without_a_version_function_is_too_old(too_old):
    assert llvm._ask_version(too_old.path) is None


@pytest.mark.parametrize("content", [b"", b"not a library"])
def test_a_file_that_is_no_library_has_no_version(tmp_path, content):
    path = tmp_path / "libLLVM.so"
    path.write_bytes(content)
    assert llvm._version(str(path)) is None


def test_find_sorts_from_new_to_old(monkeypatch, tmp_path):
    names = ["libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-9.so", "libLLVM.so.23.1"]
    monkeypatch.setattr(llvm, "_candidates", lambda: [str(tmp_path / name) for name in names])
    libraries = llvm.find()
    assert [library.version[0] for library in libraries] == [23, 19, 15, 9]
    assert [library.usable for library in libraries] == [True, True, False, False]


def test_library_of_the_environment_is_kept(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/my/libLLVM.so")
    monkeypatch.setattr(llvm, "find", pytest.fail)
    llvm.choose()
    assert os.environ[llvm.VARIABLE] == "/my/libLLVM.so"


def test_a_library_in_use_is_left_alone(monkeypatch, variant):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "find", pytest.fail)
    llvm.choose()
    assert llvm.VARIABLE not in os.environ


def test_newest_usable_library_is_chosen(usable):
    process = python(
        "import glintbsdf, mitsuba as mi\n"
        "import drjit as dr\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "print(dr.detail.llvm_version()[0], dr.minimum(mi.Float(1, 2), 1.5))"
    )
    assert process.stdout.split(maxsplit=1) == [str(usable.version[0]), "[1, 1.5]\n"], (
        process.stderr
    )


def test_too_old_a_library_is_an_error_before_drjit_aborts(too_old, usable):
    process = python("import glintbsdf, mitsuba as mi; mi.set_variant('llvm_ad_rgb')", too_old.path)
    assert process.returncode == 1  # an exception, not a signal
    assert f"Dr.Jit has loaded LLVM {too_old.version[0]}" in process.stderr
    assert f"export {llvm.VARIABLE}={usable.path}" in process.stderr


def test_too_late_an_import_says_what_to_change(too_old, usable):
    """After Dr.Jit has chosen its library, the import raises an error that says what to change."""
    process = python(
        "import os, mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        f"del os.environ['{llvm.VARIABLE}']\n"
        "import glintbsdf",
        too_old.path,
    )
    assert process.returncode == 1
    assert "Import glintbsdf before mitsuba and drjit" in process.stderr
    assert f"export {llvm.VARIABLE}={usable.path}" in process.stderr


def test_too_old_a_library_does_not_hinder_scalar_variants(too_old):
    script = "import glintbsdf, mitsuba as mi; mi.set_variant('scalar_rgb')"
    assert python(script, too_old.path).returncode == 0


def test_without_a_usable_library_the_error_says_how_to_install_one(monkeypatch):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "loaded_version", lambda: (15, 0, 6))
    monkeypatch.setattr(llvm, "find", lambda: [llvm.Library((15,), "/lib/libLLVM-15.so.1")])
    with pytest.raises(llvm.LLVMError) as error:
        llvm.require_usable()
    assert "LLVM 15" in str(error.value)
    assert llvm.install_command() in str(error.value)


def test_no_library_at_all_is_an_error(monkeypatch):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "loaded_version", lambda: None)
    monkeypatch.setattr(llvm, "find", list)
    with pytest.raises(llvm.LLVMError, match="found no LLVM library"):
        llvm.require_usable()


def test_choice_without_a_usable_library_is_silent(monkeypatch):
    """Programs that run on the GPU need no LLVM."""
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "loaded_version", lambda: None)
    monkeypatch.setattr(llvm, "find", list)
    llvm.choose()
    assert llvm.VARIABLE not in os.environ


def test_quick_kernels_compute_the_same_and_are_kept_apart(monkeypatch, tmp_path, usable):
    if usable.version[0] < llvm.QUICK_MINIMUM_VERSION:
        pytest.skip("this LLVM does not know how to compile quickly")
    script = (
        "import glintbsdf, drjit as dr, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "x = dr.arange(mi.Float, 7)\n"
        "print(dr.exp(dr.sin(x)) * dr.erfinv(x / 9), dr.fma(x, x, 0.1))"
    )
    outputs = {}
    for kernels in ("optimised", "quick"):
        monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path / f"of_{kernels}"))
        monkeypatch.setenv(llvm.QUICK_VARIABLE, kernels)
        outputs[kernels] = python(script).stdout
    assert outputs["quick"] == outputs["optimised"] != ""
    folders = {path.parent for path in tmp_path.glob("**/*.bin")}
    assert folders == {tmp_path / "of_optimised", tmp_path / "of_quick" / "quick"}


def test_an_unknown_kind_of_kernels_is_refused(monkeypatch):
    monkeypatch.setenv(llvm.QUICK_VARIABLE, "fast")
    with pytest.raises(llvm.LLVMError, match='"optimised" or "quick" \\(got "fast"\\)'):
        llvm.choose()
