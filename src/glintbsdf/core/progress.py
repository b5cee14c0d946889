"""Progress of work that turns out to be slow: a bar on a terminal, lines in a log."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_DELAY = 1.0  # seconds until a bar appears
_FIRST_LINE = 10.0  # seconds until the first line in a log; the next come ever more rarely


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show on stderr how far the block is: on a terminal a bar, from its second second on; else
    lines, after 10 seconds, 20, 40 and so on.

    Yields a function to call, or not, with the fraction done, in [0, 1]::

        with progress("Building lists") as report:
            for i in range(n):
                ...
                report((i + 1) / n)
    """
    if not sys.stderr.isatty():
        with _lines(label) as report:
            yield report
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


@contextmanager
def _lines(label: str) -> Iterator[Callable[[float], None]]:
    """Lines such as ``Rendering: 35 % after 20 s, about 37 s left``, also while nothing reports."""
    start, done, stream = time.monotonic(), 0.0, sys.stderr
    ended = threading.Event()

    def say(text: str) -> None:
        print(f"{label}: {text}", file=stream, flush=True)

    def watch() -> None:
        wait = _FIRST_LINE
        while not ended.wait(max(0.0, start + wait - time.monotonic())):
            passed = time.monotonic() - start
            if done > 0:
                left = duration(passed * (1 - done) / done)
                say(f"{100 * done:.0f} % after {duration(passed)}, about {left} left")
            else:
                say(f"{duration(passed)} so far")
            wait = 2 * wait

    def report(fraction: float) -> None:
        nonlocal done
        done = fraction

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield report
        passed = time.monotonic() - start
        if passed > _FIRST_LINE:
            ended.set()
            say(f"done in {duration(passed)}")
    finally:
        ended.set()
        thread.join()


def duration(seconds: float) -> str:
    """A length of time as one says it: ``12 s``, ``3 min 20 s``, ``2 h 05 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"
