"""Make the plugins known to Mitsuba, in every variant.

``mi.BSDF`` is a different class in each variant of Mitsuba, so classes derived from it, and with
them their modules, are loaded once per change of variant. All other modules of the package look
Mitsuba's types up when they are called and need no reloading.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable

import mitsuba as mi

from glintbsdf.bridge import llvm

_PLUGINS = "glintbsdf.plugins"
_BASE_CLASS = "glintbsdf.bridge.bsdf"
_INTEGRATORS = ("glint_path",)  # all other plugins are BSDFs


def plugin_types() -> tuple[str, ...]:
    """Return the names of all plugin types, which are the names of the plugin modules."""
    package = importlib.import_module(_PLUGINS)
    return tuple(sorted(module.name for module in pkgutil.iter_modules(package.__path__)))


def install() -> None:
    """Register the plugins in the active variant, if any, and in every one chosen later.

    Calling this again has no further effect.
    """
    mi.detail.remove_variant_callback(_on_variant_change)
    mi.detail.add_variant_callback(_on_variant_change)
    if mi.variant() is not None:
        register(mi.variant())


def register(variant: str) -> None:
    """Register every plugin type in ``variant``, which must be the active one.

    In a scalar variant a plugin type is registered as well, and creating it raises an error that
    says what to type.

    Raises:
        glintbsdf.bridge.llvm.LLVMError: the variant runs on an LLVM that makes Dr.Jit abort.
    """
    if variant.startswith("scalar"):
        for plugin_type in plugin_types():
            # Mitsuba remembers the kind of a type across variants: it must be the right one.
            is_integrator = plugin_type in _INTEGRATORS
            register_type = mi.register_integrator if is_integrator else mi.register_bsdf
            register_type(plugin_type, _refuse(plugin_type, variant))
        return

    if variant.startswith("llvm"):
        llvm.require_usable()
    for module in (_BASE_CLASS, *(f"{_PLUGINS}.{plugin_type}" for plugin_type in plugin_types())):
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


def _on_variant_change(_old: str | None, new: str) -> None:
    register(new)


def _refuse(plugin_type: str, variant: str) -> Callable[[mi.Properties], object]:
    def factory(_properties: mi.Properties) -> object:
        raise RuntimeError(
            f'{plugin_type}: needs a JIT variant of Mitsuba (the active one is "{variant}"). '
            "Before the scene is loaded, type:\n"
            "    import mitsuba as mi\n"
            '    mi.set_variant("llvm_ad_rgb")  # on an NVIDIA GPU: "cuda_ad_rgb"\n'
            "    import glintbsdf"
        )

    return factory
