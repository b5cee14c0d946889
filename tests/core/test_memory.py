"""Memory is told before it is taken, where there is much, and where there is not enough."""

from __future__ import annotations

import pytest

from glintbsdf.core import memory
from glintbsdf.core.progress import progress


@pytest.mark.parametrize("nbytes, text", [(12.4e6, "12 MB"), (4.31e9, "4.3 GB")])
def test_amounts(nbytes, text):
    assert memory.amount(nbytes) == text


def test_scarce_memory_is_told(told, monkeypatch):
    assert memory.free() is None or memory.free() > 1 << 20
    monkeypatch.setattr(memory, "free", lambda: 2_000_000_000)
    with progress("Building", 1.9e9):
        assert not told()
    with progress("Building", 4.3e9):
        (text,) = told()
    assert "Building takes about 4.3 GB of memory, and 2.0 GB are free." in text
    monkeypatch.setattr(memory, "free", lambda: None)  # who does not know says nothing
    with progress("Building", 4.3e12):
        assert not told()
