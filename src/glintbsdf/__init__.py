"""Glint BSDFs for Mitsuba 3.

Importing this package makes its plugins known to Mitsuba, in the active variant and in every one
chosen later, and points Dr.Jit to a usable LLVM. It never chooses a variant. The import is light:
maps, references and estimators load when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from glintbsdf.bridge import llvm as _llvm

# Dr.Jit loads LLVM when it is imported, so the choice comes before anything imports Mitsuba.
_llvm.choose()

from glintbsdf.bridge import registration as _registration  # noqa: E402

_registration.install()

if TYPE_CHECKING:
    from glintbsdf import maps, plot, pndf, reference
    from glintbsdf.core.errors import ParameterError
    from glintbsdf.footprint.gaussian import Footprint
    from glintbsdf.maps.normalmap import NormalMap
    from glintbsdf.scene.rendering import pixel_spread

__version__ = "0.1.0"

__all__ = [
    "Footprint",
    "NormalMap",
    "ParameterError",
    "maps",
    "pixel_spread",
    "plot",
    "pndf",
    "reference",
]

_HOMES = {
    "Footprint": "footprint.gaussian",
    "NormalMap": "maps.normalmap",
    "ParameterError": "core.errors",
    "pixel_spread": "scene.rendering",
}


def __getattr__(name: str) -> object:
    """Load a public name of :data:`__all__` on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f".{_HOMES.get(name, name)}", __name__)
    value = getattr(module, name) if name in _HOMES else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
