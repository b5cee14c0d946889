"""The base classes of BSDFs, by their public name: for BSDFs of one's own, and to ask what one is.

They live in :mod:`glintbsdf.bridge.bsdf`, which is imported anew in every variant of Mitsuba. The
classes found here are always those of the active variant.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from glintbsdf.bridge.bsdf import FootprintBSDF, GlintBSDF

__all__ = ["FootprintBSDF", "GlintBSDF"]


def __getattr__(name: str) -> type:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("glintbsdf.bridge.bsdf"), name)
