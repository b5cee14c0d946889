"""``python -m benchmarks --method MODULE`` compares a method of one's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

SCRIPT = """
from benchmarks.__main__ import benchmarks

benchmarks.main(["--method", "waves", "cost", "--help"], standalone_mode=False)
from benchmarks.methods import METHODS

(own,) = [method for method in METHODS if method.plugin["type"] == "glint_waves"]
print("compared:", own.family, own.cost, own.mapped)
"""


def test_a_method_of_ones_own_is_compared():
    process = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT / "docs" / "examples")},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr
    assert "compared: waves True False" in process.stdout
