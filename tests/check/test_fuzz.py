"""Values of every kind for every parameter are either used, or refused in one sentence."""

from __future__ import annotations

import pytest

from glintbsdf.bridge.parameters import PARAMETERS
from glintbsdf.bridge.registration import plugin_types
from glintbsdf.check.fuzz import GOOD, Case, Report, cases, fuzz, judged, outcome


def test_cases_follow_their_seed():
    first, again, other = ([str(c) for c in cases(seed, 50)] for seed in (1, 1, 2))
    assert first == again != other
    assert {case.plugin for case in cases(1, 500)} == set(PARAMETERS)


def test_every_plugin_declares_its_parameters():
    assert set(plugin_types()) == set(PARAMETERS)


def test_every_value_is_used_or_refused(variant):
    report = Report()
    for case in cases(3, 600):
        report.add(case, outcome(case, evaluate=False))
    assert not report.faults, str(report)
    assert report.counts["refused"] > 300 and report.counts["used"] > 30


def test_used_values_are_finite():
    """In separate processes, so that crashes and endless loops are outcomes, too."""
    report = fuzz(60, seed=4)
    assert not report.faults, str(report)
    assert report.cases == 60 and report.counts["used"] > 2


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ('At "root": ParameterError: glint_grid: "alpha" must be … (got 3)', "refused"),
        ('Traceback\n  …\nParameterError: glint_grid: "alpha" must be …', "no sentence"),
        ('At "root": ParameterError: glint_grid: "alpha" must be …\n1', "no sentence"),
        ('At "root": ParameterError: glint_grid: "beta" must be …', "another parameter"),
        ("At root: TypeError: unsupported operand", "other"),
    ],
)
def test_faults_are_told_apart(message, expected):
    case = Case("glint_grid", {"alpha": ("float", 3.0)})
    result = judged(case, message)
    assert result.startswith(expected) and (result in GOOD) == (expected == "refused")
