"""Constants tuned by measurement, one table per backend, and how many cores there are.

What is here changes how fast an answer comes, and at most its last digits.
"""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """The constants of one backend.

    Attributes:
        few_quads (int): footprints of the manifold that touch no more quads than this are summed
            quad by quad; larger ones use the inverted lists.
        few_cells (int): the same for the cells of elements.
        lobes_per_turn (int): lobes that one turn of the loop over MIP-mapped lobes takes.
        nodes_per_turn (int): nodes that one turn of the loop over the tables takes.
    """

    few_quads: int = 25
    few_cells: int = 25
    lobes_per_turn: int = 4
    nodes_per_turn: int = 2


#: Measured on two x86-64 cores with AVX2, LLVM 19 and 23. On the GPU nothing has been measured yet:
#: its table starts from the same numbers.
TABLES = {"llvm": Tuning(), "cuda": Tuning()}


def tuning() -> Tuning:
    """The constants of the active variant's backend."""
    import mitsuba as mi

    backend = (mi.variant() or "llvm").partition("_")[0]
    return TABLES.get(backend, TABLES["llvm"])


def usable_cores() -> int:
    """Cores that this process may run on, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
