"""Make the plugins known to Mitsuba, in every variant.

``mi.BSDF`` is a different class in each variant of Mitsuba, so classes derived from it, and with
them their modules, are loaded once per change of variant. All other modules of the package look
Mitsuba's types up when they are called and need no reloading.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Callable

import mitsuba as mi

from glintbsdf.bridge import llvm
from glintbsdf.core.errors import ParameterError

_PLUGINS = "glintbsdf.plugins"
_BASE_CLASS = "glintbsdf.bridge.bsdf"
_INTEGRATORS = ("glint_path",)  # all other plugins are BSDFs

#: Entry points of this group name modules of other packages with plugins of their own.
GROUP = "glintbsdf.plugins"

_added: list[str] = []
_bsdfs: set[str] = set()


class VariantError(RuntimeError):
    """A plugin is asked for in a variant of Mitsuba in which it cannot be."""


def register_plugin(plugin_type: str, made: Callable[[mi.Properties], object]) -> None:
    """Register a plugin in the active variant.

    ``made``: the plugin's class, or a function that makes the plugin from its properties. The types
    in ``_INTEGRATORS`` and classes of integrators are registered as integrators, all others as
    BSDFs.

    Whoever loads the scene gets an error about a parameter as one sentence. For all other errors
    Mitsuba prints Python's traceback before the message; Python 3.10 has the traceback always.
    """

    def make(props: mi.Properties) -> object:
        try:
            plugin = made(props)
            for name in props.unqueried():
                raise ParameterError(
                    f'{plugin_type}: "{name}" is of no use beside the other parameters given'
                )
            return plugin
        except (ParameterError, VariantError) as error:
            # What is raised again without a name keeps this, instead of the frames it has left.
            error.__traceback__ = None
            raise

    is_class = isinstance(made, type) and issubclass(made, mi.Integrator)
    if is_class or plugin_type in _INTEGRATORS:
        mi.register_integrator(plugin_type, make)
    else:
        mi.register_bsdf(plugin_type, make)
        _bsdfs.add(plugin_type)


def plugin_types() -> tuple[str, ...]:
    """Return the names of all plugin types, which are the names of the plugin modules."""
    package = importlib.import_module(_PLUGINS)
    return tuple(sorted(module.name for module in pkgutil.iter_modules(package.__path__)))


def bsdf_types() -> frozenset[str]:
    """Return the types of all BSDFs that have been registered, those of other packages included."""
    return frozenset(_bsdfs)


def add_plugins(module: str) -> None:
    """Import a module with plugins of your own, now and in every variant chosen later.

    The module must be importable by its name. Packages have an entry point of :data:`GROUP`
    instead.

    Raises:
        ImportError: there is no such module, or it cannot be imported.
    """
    variant = mi.variant()
    if variant is not None and not variant.startswith("scalar"):
        _load(module)
    elif importlib.util.find_spec(module) is None:
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)
    if module not in _added:
        _added.append(module)


def modules_of_others() -> list[str]:
    """Modules of other packages with plugins: by entry points, and by :func:`add_plugins`."""
    from importlib.metadata import entry_points

    named = [entry.module for entry in entry_points(group=GROUP)]
    return list(dict.fromkeys([*named, *_added]))


def _load(module: str) -> None:
    """Import a module, or import it anew for the classes of the active variant."""
    if module in sys.modules:
        importlib.reload(sys.modules[module])
    else:
        importlib.import_module(module)


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
            register_plugin(plugin_type, _refuse(plugin_type, variant))
        return

    if variant.startswith("llvm"):
        llvm.require_usable()
    own = (f"{_PLUGINS}.{plugin_type}" for plugin_type in plugin_types())
    for module in (_BASE_CLASS, *own, *modules_of_others()):
        _load(module)


def _on_variant_change(_old: str | None, new: str) -> None:
    register(new)


def _refuse(plugin_type: str, variant: str) -> Callable[[mi.Properties], object]:
    def factory(_properties: mi.Properties) -> object:
        raise VariantError(
            f'{plugin_type}: needs a JIT variant of Mitsuba (the active one is "{variant}"). '
            "Before the scene is loaded, type:\n"
            "    import mitsuba as mi\n"
            '    mi.set_variant("llvm_ad_rgb")  # on an NVIDIA GPU: "cuda_ad_rgb"\n'
            "    import glintbsdf"
        )

    return factory
