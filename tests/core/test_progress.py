"""Slow work shows its progress: by a bar on a terminal, by lines in a log."""

from __future__ import annotations

import io
import sys
import time

import pytest

from glintbsdf.core import progress as module
from glintbsdf.core.progress import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    "stream, seconds, shown",
    [(Terminal(), 0.5, True), (Terminal(), 0.0, False), (io.StringIO(), 0.5, False)],
)
def test_progress(monkeypatch, stream, seconds, shown):
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(module, "_DELAY", 0.1)
    monkeypatch.setenv("TERM", "xterm")
    with progress("Building lists") as report:
        report(0.25)
        time.sleep(seconds)
        report(1.0)
    assert ("Building lists" in stream.getvalue()) == shown


def test_bars_are_under_each_other(monkeypatch):
    """Work may be a part of other work: both have a bar, and the last takes the display away."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(module, "_DELAY", 0.05)
    monkeypatch.setenv("TERM", "xterm")
    with progress("Inspecting"):
        with progress("Building lists") as report:
            report(0.5)
            time.sleep(0.4)
        assert module._bars.shown is not None
    assert "Inspecting" in stream.getvalue() and "Building lists" in stream.getvalue()
    assert module._bars.shown is None and not module._bars.timers


def test_much_time_is_foreseen(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(module, "_SURE", 0.0)
    for fraction, expected in ((1e-4, 1), (0.9, 0)):
        stream.truncate(0)
        with progress("Rendering", 3e9) as report:
            time.sleep(0.05)
            report(fraction)
            report(2 * fraction)
        assert stream.getvalue().count("Rendering (3.0 GB): 0 % after 0 s, about ") == expected


def test_errors_pass_through(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with pytest.raises(RuntimeError, match="no"), progress("Building"):
        raise RuntimeError("no")


def test_lines_in_a_log(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(module, "_FIRST_LINE", 0.1)
    with progress("Rendering") as report:
        time.sleep(0.15)
        report(0.5)
        time.sleep(0.1)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "Rendering: 0 s so far"
    assert lines[1].startswith("Rendering: 50 % after 0 s, about 0 s left")
    assert lines[-1] == "Rendering: done in 0 s" and len(lines) == 3


def test_durations():
    assert [module.duration(s) for s in (0.4, 59, 200, 7500)] == [
        "0 s",
        "59 s",
        "3 min 20 s",
        "2 h 05 min",
    ]
