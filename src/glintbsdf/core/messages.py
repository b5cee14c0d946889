"""Warnings and information for the user, all through Mitsuba's log.

Its level is Mitsuba's, ``mi.set_log_level``: warnings show by default, information does not.
"""

from __future__ import annotations

import sys


def warn(message: str) -> None:
    """Tell what may not be as the user means it, in one line. Mitsuba's log speaks in a variant
    only: before one is chosen, the message is a line on stderr."""
    import mitsuba as mi

    if mi.variant() is None:
        print(message, file=sys.stderr)
    else:
        mi.Log(mi.LogLevel.Warn, message)  # type: ignore[operator]  # an object in the stubs


def inform(message: str) -> None:
    """Tell what has been decided, in one line, to who asks for information."""
    import mitsuba as mi

    if mi.variant() is not None:
        mi.Log(mi.LogLevel.Info, message)  # type: ignore[operator]  # as above
