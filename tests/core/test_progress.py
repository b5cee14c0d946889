"""The progress bar appears for slow work on a terminal, and never else."""

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


def test_errors_pass_through(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with pytest.raises(RuntimeError, match="no"), progress("Building"):
        raise RuntimeError("no")
