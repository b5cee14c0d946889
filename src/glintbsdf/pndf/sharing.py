"""Structures that P-NDFs of one map have in common: materials often differ in colour only."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import mitsuba as mi

Structure = TypeVar("Structure")

_made: WeakValueDictionary[tuple, Any] = WeakValueDictionary()


def shared(of: Any, make: Callable[[], Structure], *key: Hashable) -> Structure:
    """What ``make()`` returns, or has returned for the same map and key, if that is still in use.

    It must not be changed afterwards. Mitsuba loads plugins side by side, and they do not wait for
    one another: the first few may each make their own.

    Args:
        of: the P-NDF or mesh, whose map the structure is made of. Nothing is shared once this has
            been ``changed``, or where there is no map.
        key: the kind of the structure, and every parameter that it depends on.
    """
    if of.changed or of.normal_map is None:
        return make()
    key = (mi.variant(), mi.Float, of.normal_map.content_hash, *key)
    found = _made.get(key)
    if found is None:
        found = _made[key] = make()
    return found
