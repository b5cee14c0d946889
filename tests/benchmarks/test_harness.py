"""The harness of the benchmarks: options, tables, continuation, and the list of commands."""

from __future__ import annotations

import json
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import harness
from benchmarks.__main__ import COMMANDS, benchmarks

ROOT = Path(__file__).parents[2]

measured: list = []


def numbers(run: harness.Run) -> None:
    """Squares of a few numbers."""
    with run.table("numbers") as table:
        for x in (1, 2) if run.quick else (1, 2, 3):
            table.measure({"x": x}, lambda x=x: square(x))
    run.save_pictures("a picture", [[np.full((2, 3), 0.5), np.full((2, 3, 3), 1.0)]])


def square(x: int) -> list[dict]:
    measured.append(x)
    if measured.count(2) == 1 and x == 2:
        raise KeyboardInterrupt
    return [{"power": 2, "value": x**2}, {"power": 0.5, "value": None}]


@pytest.fixture
def command(variant):
    measured.clear()
    family = harness.family("squares", numbers)
    return lambda *options: CliRunner().invoke(family, ["-m", variant, *options])


def test_a_command_goes_on_where_it_stopped(command, tmp_path):
    output = ("-o", str(tmp_path / "results"))
    assert command(*output).exit_code == 1
    assert measured == [1, 2]
    rows = json.loads((tmp_path / "results" / "squares.json").read_text())["numbers"]
    assert rows == [{"x": 1, "power": 2, "value": 1}, {"x": 1, "power": 0.5, "value": None}]

    done = command(*output)
    assert done.exit_code == 0 and measured == [1, 2, 2, 3]
    found = json.loads((tmp_path / "results" / "squares.json").read_text())
    assert [row["value"] for row in found["numbers"]] == [1, None, 4, None, 9, None]
    assert found["machine"]["variant"] and found["quick"] is False
    assert (tmp_path / "results" / "a-picture.png").exists()
    assert command(*output).exit_code == 0 and measured == [1, 2, 2, 3]
    # Other settings are other units.
    command("--quick", *output)
    assert measured == [1, 2, 2, 3, 1, 2]


def test_only_some_rows(command):
    shown = command("--only", "numbers, 3")
    assert shown.exit_code == 0 and measured == [3]
    assert "squares" not in shown.output
    # A row that lacks a value has a dash.
    assert "9" in shown.output and "–" in shown.output
    assert command("others").exit_code == 2


def test_times_are_taken_in_turn():
    calls = []
    works = [lambda k: calls.append(("a", k)), lambda k: calls.append(("b", k))]
    times = harness.seconds_in_turn(works, 2)
    assert calls == [("a", 1), ("b", 1), ("a", 2), ("b", 2)] and times.shape == (2, 2)
    # The median of ratios is not the ratio of medians.
    assert harness.ratios_to_first(np.array([[1, 2], [10, 10], [2, 6]]))[1] == 2


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_and_a_place_on_a_page(name):
    shown = CliRunner().invoke(benchmarks, [name, "--help"])
    assert shown.exit_code == 0 and "--quick" in shown.output and "--output" in shown.output
    pages = "".join(page.read_text() for page in (ROOT / "docs" / "reports").glob("*.rst"))
    assert f"``{name}``" in pages or f"python -m benchmarks {name}" in pages
    module = import_module(f"benchmarks.commands.{name}")
    assert getattr(module, name).short_help


def test_methods_of_the_register_take_part():
    from benchmarks import methods
    from glintbsdf.check import stiff
    from glintbsdf.pndf import methods as registered

    for entry in registered().values():
        assert entry.plugin in {method.plugin["type"] for method in methods.METHODS}
        assert entry.plugin in {setting.plugin for setting in stiff.STIFF.values()}
    names = [method.name for method in methods.METHODS]
    assert len(set(names)) == len(names)


def test_commands_that_pages_name_exist():
    folders = ("src", "plugins", "docs", "benchmarks")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.*")]
    files = [f for f in files if f.suffix in (".py", ".rst", ".md") and "_build" not in f.parts]
    named: set[tuple[str, str]] = set()
    for file in [*files, ROOT / "README.md"]:
        words = r"(?:-m |``)benchmarks ([a-z_]+)(?: ([a-z_]+))?"
        named |= set(re.findall(words, file.read_text(encoding="utf-8")))
    assert len(named) > 8
    for command, part in named:
        known = benchmarks.get_command(None, command)
        assert known is not None, command
        choices = known.params[0].type
        if part and hasattr(choices, "choices"):
            assert part in choices.choices, (command, part)
