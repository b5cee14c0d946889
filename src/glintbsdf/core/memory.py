"""How much memory work takes, and whether there is as much."""

from __future__ import annotations

import os
from math import sqrt
from pathlib import Path

from glintbsdf.core.errors import check
from glintbsdf.core.messages import warn

#: Memory that is worth telling before it is taken, bytes.
NOTABLE = 1 << 29


def amount(nbytes: float) -> str:
    """A number of bytes as one says it: ``12 MB``, ``4.3 GB``."""
    return f"{nbytes / 1e9:.1f} GB" if nbytes >= 1e9 else f"{nbytes / 1e6:.0f} MB"


def free() -> int | None:
    """Bytes of main memory that are free for use; None where the system does not tell."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def warn_if_scarce(work: str, nbytes: float) -> None:
    """Warn, before ``work`` begins, where it takes more memory than is free."""
    there = free()
    if there is not None and nbytes > there:
        warn(
            f"{work} takes about {amount(nbytes)} of memory, and {amount(there)} are free. "
            "A smaller map takes less; glintbsdf render --trim builds what the scene asks for alone"
        )


def check_room(owner: str, parameter: str, shape: tuple[int, int], bytes_per_texel: float) -> None:
    """Refuse a map that takes more memory than is free, before any is taken.

    Args:
        owner, parameter: names for the message.
        shape: rows and columns of the map.
        bytes_per_texel: memory that building takes at most, for each texel.

    Raises:
        ParameterError: the map does not fit. The message tells what it takes, and what would fit.
    """
    there, needed = free(), shape[0] * shape[1] * bytes_per_texel
    if there is None or needed <= there:
        return
    rows, columns = (max(1, int(n * sqrt(there / needed))) for n in shape)
    check(
        False,
        owner,
        parameter,
        f"a map of at most {columns} × {rows} texels, as {amount(there)} of memory are free "
        "(glintbsdf render --trim builds what a scene asks for alone)",
        f"{shape[1]} × {shape[0]} texels, which take about {amount(needed)}",
    )
