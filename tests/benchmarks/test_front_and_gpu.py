"""The benchmarks ``front`` and ``gpu``, small, without a GPU."""

from __future__ import annotations

import json
from importlib import import_module

from click.testing import CliRunner


def results(command: str, folder, *options: str) -> dict:
    """What a command of the benchmarks finds for the filters alone."""
    family = getattr(import_module(f"benchmarks.commands.{command}"), command)
    options = ("--quick", "--repetitions", "1", "-o", str(folder), *options)
    done = CliRunner().invoke(family, options)
    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads((folder / f"{command}.json").read_text())


def test_front(variant, tmp_path):
    (row,) = results("front", tmp_path, "--only", "glint_filtered", "-m", variant)["plugins"]
    assert row["plugin"] == "glint_filtered" and row["size"] == 128
    assert 0 < row["resident"] <= 1.01 * row["peak"] < 2
    assert row["kernels"] >= 1 and row["operations"] > 1000
    assert 0 < row["load"] and 0 < row["compiling"] < row["frame"]


def test_gpu(variant, tmp_path):
    parts = ("agreement", "throughput")
    found = results("gpu", tmp_path, *parts, "--only", "filter", "-m", variant)
    (row,) = found["agreement"]
    assert row["suite"] == "passed" and max(row["value"], row["pdf"]) < 1e-4
    assert {row["method"] for row in found["throughput"]} == {"filter, toksvig", "filter, lean"}
    assert all(row["million_per_second"] > 0 for row in found["throughput"])
