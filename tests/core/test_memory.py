"""Memory is told before it is taken, where there is much, and where there is not enough."""

from __future__ import annotations

import pytest

from glintbsdf import maps
from glintbsdf.core import memory
from glintbsdf.core.errors import ParameterError
from glintbsdf.core.progress import progress
from glintbsdf.pndf import Elements, Filtered, Manifold


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


@pytest.mark.parametrize("pndf", [Manifold, Elements, Filtered])
def test_a_map_that_does_not_fit_is_refused_before_anything_is_built(variant, monkeypatch, pndf):
    normal_map = maps.flat((100, 200))
    needed = 100 * 200 * pndf.bytes_per_texel
    monkeypatch.setattr(memory, "free", lambda: int(needed / 3.99))
    monkeypatch.setattr(pndf, "build", lambda *_: pytest.fail("built"))
    with pytest.raises(ParameterError) as caught:
        pndf(normal_map, owner="a_plugin")
    assert str(caught.value) == (
        'a_plugin: "normals" must be a map of at most 100 × 50 texels, as 1 MB of memory are free '
        "(glintbsdf render --trim builds what a scene asks for alone) "
        f'(got "200 × 100 texels, which take about {memory.amount(needed)}")'
    ).replace("1 MB", memory.amount(needed / 3.99))
    monkeypatch.setattr(memory, "free", lambda: int(needed))
    with pytest.raises(pytest.fail.Exception, match="built"):
        pndf(normal_map)
