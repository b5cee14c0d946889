"""Structures that P-NDFs of one map have in common: materials often differ in colour only."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import mitsuba as mi

Structure = TypeVar("Structure")

_made: WeakValueDictionary[tuple, Any] = WeakValueDictionary()

_waiting: deque[Callable[[], None]] = deque()
_one_builds = Lock()


def in_turn(build: Callable[[], None]) -> None:
    """Call ``build``, now or, while another one runs, when that has ended.

    Mitsuba loads the plugins of a scene side by side, and a thread that waits for a kernel loads
    the next one meanwhile. Dr.Jit cannot follow two computations that take turns like this; they
    would make shared structures twice, and need the memory of both. Nobody may wait for the other
    build, which could be further down in the same thread. So whoever builds also builds what came
    in the meantime. Mitsuba ends loading when all have returned.

    Raises:
        Exception: the first one of the builds that were called.
    """
    _waiting.append(build)
    errors = []
    while _waiting and _one_builds.acquire(blocking=False):
        try:
            while _waiting:
                try:
                    _waiting.popleft()()
                except Exception as error:
                    errors.append(error)
        except BaseException:  # an interruption
            _waiting.clear()
            raise
        finally:
            _one_builds.release()
    if errors:
        raise errors[0]


def shared(of: Any, make: Callable[[], Structure], *key: Hashable) -> Structure:
    """What ``make()`` returns, or has returned for the same map and key, if that is still in use.

    It must not be changed afterwards.

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
