"""Progress of work that turns out to be slow: a bar on a terminal, lines in a log.

Time and memory that will be long and much are told at once.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from glintbsdf.core.memory import NOTABLE, amount, warn_if_scarce

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_DELAY = 1.0  # seconds until a bar appears
_FIRST_LINE = 10.0  # seconds until the first line in a log; the next come ever more rarely
_SURE, _LONG = 1.0, 30.0  # seconds after which more than so many are foreseen in a line of its own


@contextmanager
def progress(label: str, nbytes: float = 0) -> Iterator[Callable[[float], None]]:
    """Show on stderr how far the block is: on a terminal a bar, from its second second on; else
    lines, as soon as much time is foreseen, and after 10 seconds, 20, 40 and so on.

    ``nbytes``: memory that the work takes. Much is shown with the label, and more than is free is
    warned of.

    Yields a function to call, or not, with the fraction done, in [0, 1]::

        with progress("Building lists") as report:
            for i in range(n):
                ...
                report((i + 1) / n)
    """
    if nbytes >= NOTABLE:
        warn_if_scarce(label, nbytes)
        label += f" ({amount(nbytes)})"
    if not sys.stderr.isatty():
        with _lines(label) as report:
            yield report
        return

    task = _bars.add(label)
    try:
        yield lambda fraction: _bars.update(task, fraction)
    finally:
        _bars.remove(task)


class _Bars:
    """The bars on the terminal, under each other: work may be a part of other work, and Mitsuba
    loads plugins side by side."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.shown: Progress | None = None
        self.timers: dict[TaskID, threading.Timer] = {}

    def add(self, label: str) -> TaskID:
        """A bar, which appears when the work turns out to be slow."""
        from rich.console import Console
        from rich.progress import Progress

        with self.lock:
            if self.shown is None:
                self.shown = Progress(console=Console(stderr=True), transient=True)
            task = self.shown.add_task(label, total=None, visible=False)
            timer = self.timers[task] = threading.Timer(_DELAY, self.show, (task,))
        timer.daemon = True
        timer.start()
        return task

    def show(self, task: TaskID) -> None:
        """Let a bar appear."""
        with self.lock:
            if self.shown is not None and task in self.timers:
                self.shown.update(task, visible=True)
                self.shown.start()

    def update(self, task: TaskID, fraction: float) -> None:
        """Move a bar."""
        if self.shown is not None:
            self.shown.update(task, completed=fraction, total=1)

    def remove(self, task: TaskID) -> None:
        """Take a bar away."""
        with self.lock:
            self.timers.pop(task).cancel()
            if self.shown is not None:
                self.shown.remove_task(task)
                if not self.timers:
                    self.shown.stop()
                    self.shown = None


_bars = _Bars()


@contextmanager
def _lines(label: str) -> Iterator[Callable[[float], None]]:
    """Lines such as ``Rendering: 35 % after 20 s, about 37 s left``, also while nothing reports."""
    start, done, stream = time.monotonic(), 0.0, sys.stderr
    ended, foreseen = threading.Event(), False

    def say(text: str) -> None:
        print(f"{label}: {text}", file=stream, flush=True)

    def say_how_far(passed: float) -> None:
        if done > 0:
            left = duration(passed * (1 - done) / done)
            say(f"{100 * done:.0f} % after {duration(passed)}, about {left} left")
        else:
            say(f"{duration(passed)} so far")

    def watch() -> None:
        wait = _FIRST_LINE
        while not ended.wait(max(0.0, start + wait - time.monotonic())):
            say_how_far(time.monotonic() - start)
            wait = 2 * wait

    def report(fraction: float) -> None:
        nonlocal done, foreseen
        done, passed = fraction, time.monotonic() - start
        if not foreseen and _SURE < passed < _FIRST_LINE and passed > _LONG * done > 0:
            foreseen = True
            say_how_far(passed)

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
