"""A progress bar for work that turns out to be slow."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_DELAY = 1.0  # seconds


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show a bar on stderr while the block runs, from its second second on, if that is a terminal.

    Yields a function to call, or not, with the fraction done, in [0, 1]::

        with progress("Building lists") as report:
            for i in range(n):
                ...
                report((i + 1) / n)
    """
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return

    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(console=Console(stderr=True), transient=True)
    task = bar.add_task(label, total=None)
    timer = threading.Timer(_DELAY, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda fraction: bar.update(task, completed=fraction, total=1)
    finally:
        timer.cancel()
        timer.join()
        if bar.live.is_started:
            bar.stop()
