"""The report of ``glintbsdf doctor``."""

from __future__ import annotations

import importlib.metadata

import drjit as dr
import mitsuba as mi
import pytest

from glintbsdf.bridge import llvm
from glintbsdf.cli import doctor


@pytest.fixture(scope="module")
def report() -> dict[str, doctor.Finding]:
    return {finding.name: finding for finding in doctor.examine()}


def test_reports_versions(report):
    assert report["Mitsuba"].value == mi.__version__
    assert report["Dr.Jit"].value == dr.__version__
    assert report["OpenEXR"].value == importlib.metadata.version("OpenEXR")
    assert all(library.path in report["LLVM found"].value for library in llvm.find())


def test_lists_the_variants_that_run(report, variant):
    assert variant in report["Variants that run"].value.split(", ")
    assert not report["Variants that run"].fatal
    assert "scalar" not in report["Variants that run"].value


def test_one_thread_is_reported():
    count = dr.thread_count()
    dr.set_thread_count(1)
    try:
        finding = doctor._threads()
    finally:
        dr.set_thread_count(count)
    assert finding.value == "1" and "drjit.set_thread_count(2)" in finding.remedy


def test_a_missing_package_is_fatal_and_has_a_command():
    finding = doctor._package("no-such-package-glintbsdf")
    assert finding.fatal and "-m pip install no-such-package-glintbsdf" in finding.remedy


def test_a_missing_optional_package_is_not_fatal(report):
    finding = doctor._package("no-such-package-glintbsdf", "render --denoise")
    assert not finding.fatal and "optional: for render --denoise" in finding.value
    assert "-m pip install no-such-package-glintbsdf" in finding.remedy
    assert "mitsuba-oidn" in report and "distributed" in report


def test_an_unusable_llvm_has_a_remedy(monkeypatch):
    monkeypatch.setattr(llvm, "loaded_version", lambda: (15, 0, 6))
    monkeypatch.setattr(llvm, "find", lambda: [llvm.Library((15,), "/lib/libLLVM-15.so.1")])
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    found, used = doctor._llvm()
    assert found.value == "15 (/lib/libLLVM-15.so.1)"
    assert used.value == "15.0.6" and llvm.install_command() in used.remedy


def test_a_backend_that_aborts_is_reported(monkeypatch, variant):
    monkeypatch.setattr(doctor, "_PROBE", "import os; os.abort()")
    finding = doctor._variants()
    assert finding.fatal and finding.value == "none" and "exit status" in finding.remedy
