"""Scenes that are gone, and what Python still holds of them."""

from __future__ import annotations

import gc


def collect_former_scenes() -> None:
    """Free BSDFs of older scenes that are left in reference cycles.

    It must be called before a scene is loaded or rendered. Dr.Jit records calls of all BSDFs that
    exist. If Python's garbage collector freed one of them during the recording, Dr.Jit would follow
    a dangling pointer.
    """
    gc.collect()
