"""Scenes that are gone, and what Python still holds of them."""

from __future__ import annotations

import gc


def collect_former_scenes() -> None:
    """Free the BSDFs of former scenes that are left in reference cycles; for whoever is about to
    load or to render a scene.

    Dr.Jit records a call of every BSDF that is alive. Were one freed by Python's collector while
    that goes on, Dr.Jit would follow a pointer to nothing.
    """
    gc.collect()
