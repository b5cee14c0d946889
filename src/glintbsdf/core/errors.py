"""Errors in one sentence.

That of a wrong parameter names the plugin, the parameter, the allowed values, and the given one.
"""

from __future__ import annotations

import re
from collections.abc import Callable


class ParameterError(ValueError):
    """A parameter of a plugin or function has a value that is not allowed."""


LONGEST = 200  # characters of a value that an error quotes


def describe(value: object) -> str:
    """Show a value as an error quotes it: in one line, strings in double quotes, else by repr."""
    text = " ".join(str(value).split() if isinstance(value, str) else repr(value).split())
    if len(text) > LONGEST:
        text = text[: LONGEST - 1] + "…"
    return f'"{text}"' if isinstance(value, str) else text


def check(condition: bool, owner: str, parameter: str, requirement: str, got: object) -> None:
    """Raise :class:`ParameterError` unless ``condition`` holds.

    The message reads ``owner: "parameter" must be requirement (got value)``, for example
    ``glint_manifold: "kernel" must be one of gaussian, disk, box (got "gauss")``.
    """
    if not condition:
        raise ParameterError(f'{owner}: "{parameter}" must be {requirement} (got {describe(got)})')


def check_choice(owner: str, parameter: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise :class:`ParameterError` unless ``value`` is one of ``choices``."""
    check(
        isinstance(value, str) and value in choices,
        owner,
        parameter,
        "one of " + ", ".join(choices),
        value,
    )


def check_whole(
    value: object, fits: Callable[[int], bool], owner: str, parameter: str, requirement: str
) -> None:
    """Raise :class:`ParameterError` unless ``value`` is a whole number that ``fits``."""
    fitting = isinstance(value, int) and not isinstance(value, bool) and fits(value)
    check(fitting, owner, parameter, f"a whole number {requirement}", value)


def one_line(message: str) -> str:
    """Return an error message without the Python traceback, the class of the error and the place
    in Mitsuba's sources.

    Mitsuba wraps the error of a Python plugin in its own message, with all of these.
    """
    message = re.sub(r"^\[\w+\.cpp:\d+\] ", "", message)
    message = re.sub(r"Traceback \(most recent call last\):\n(?:  .*\n)+", "", message)
    message = re.sub(r"(?<=: )[\w.]*Error: ", "", message)
    return " ".join(message.split())
