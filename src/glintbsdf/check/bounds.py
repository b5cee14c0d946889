"""Bounds of the figures in :mod:`.robustness`: which of them a BSDF must keep, and whether it does.

A table of many BSDFs has many statistical tests. Their significance together is
:data:`SIGNIFICANCE`, so a single test has Šidák's smaller one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

SIGNIFICANCE = 0.01
MASS_BOUND, DOUBLE_BOUND, BRIGHT_BOUND = 1e-3, 1e-3, 1e-5
LAST_DIGITS = 4  # rounding may change a value as much as this many last digits of the input
UNRESOLVED = 0.01  # an integral with a larger error is not judged as good


@dataclass(frozen=True)
class Cell:
    """One figure of the table; ``text`` is empty if the column does not apply."""

    text: str = ""
    broken: bool = False


@dataclass(frozen=True)
class Judge:
    """The bounds, for a table with ``tests`` statistical tests of a kind."""

    tests: int

    @property
    def smallest_p(self) -> float:
        """Significance of a single test, by Šidák's correction."""
        return 1 - (1 - SIGNIFICANCE) ** (1 / self.tests)

    @property
    def sigmas(self) -> float:
        """Number of standard errors by which an estimate may be wrong."""
        return float(scipy.stats.norm.isf(self.smallest_p / 2))

    def bounds(self) -> dict[str, str]:
        """The bound of each column, in words."""
        error = f"{self.sigmas:.1f} errors"
        return {
            "NaN": "0",
            "negative": "0",
            "∫D − 1": f"≤ {MASS_BOUND:g} + {error}; error ≤ {UNRESOLVED:g}",
            "float64": f"≤ {DOUBLE_BOUND:g} + {LAST_DIGITS} last digits",
            "χ²": f"p ≥ {self.smallest_p:.2g}",
            "furnace": f"≤ 1 + {MASS_BOUND:g} + {error}",
            "bright": f"≤ {BRIGHT_BOUND:g}",
        }

    def cells(self, result: dict) -> dict[str, Cell]:
        """The columns of a measured row; columns that do not apply are empty."""
        verdicts = {
            "NaN": ("extremes", self.nan),
            "negative": ("extremes", self.negative),
            "∫D − 1": ("densities", self.mass),
            "float64": ("double", self.double),
            "χ²": ("densities", self.chi_squared),
            "furnace": ("energies", self.furnace),
            "bright": ("bright", self.bright),
        }
        cells = {}
        for name, (measured, verdict) in verdicts.items():
            cells[name] = Cell()
            if {measured, "load"} & set(result["errors"]):
                cells[name] = Cell("error", True)
            elif measured in result:
                cells[name] = verdict(result)
        if not result.get("resolved", True):
            for name in ("∫D − 1", "float64", "χ²"):
                cells[name] = Cell(f"({cells[name].text})")
        return cells

    def nan(self, result: dict) -> Cell:
        return Cell(str(result["extremes"]["nan"]), result["extremes"]["nan"] > 0)

    def negative(self, result: dict) -> Cell:
        return Cell(str(result["extremes"]["negative"]), result["extremes"]["negative"] > 0)

    def mass(self, result: dict) -> Cell:
        """The integral that exceeds its error the most."""
        masses = [*result["densities"], *result.get("mean", [])]
        worst = max(masses, key=lambda d: self.beyond(abs(d["mass"]), d["mass_error"]))
        value, error = worst["mass"], worst["mass_error"]
        kept = self.beyond(abs(value), error) <= MASS_BOUND and error <= UNRESOLVED
        return Cell(f"{value:+.4f} ± {error:.4f}", not kept)

    def double(self, result: dict) -> Cell:
        error, last_digit = result["double"]["error"], result["double"]["last_digit"]
        return Cell(f"{error:.1e}", not error <= DOUBLE_BOUND + LAST_DIGITS * last_digit)

    def chi_squared(self, result: dict) -> Cell:
        smallest = min(density["p_value"] for density in result["densities"])
        return Cell(f"{smallest:.2g}", not smallest >= self.smallest_p)

    def furnace(self, result: dict) -> Cell:
        """The energy that exceeds its error the most."""
        worst = max(result["energies"], key=lambda e: self.beyond(e["energy"], e["error"]))
        kept = self.beyond(worst["energy"], worst["error"]) <= result["energy_limit"] + MASS_BOUND
        limit = result["energy_limit"]
        text = f"{worst['energy']:.3f} ± {worst['error']:.3f}"
        return Cell(text + (f" of {limit:.3g}" if limit != 1 else ""), not kept)

    def bright(self, result: dict) -> Cell:
        bright = result["bright"]
        kept = bright["apart"] <= BRIGHT_BOUND and not bright["nan"] and not bright["negative"]
        return Cell(f"{bright['apart']:.1e}", not kept)

    def beyond(self, value: float, error: float) -> float:
        """The part of a value that noise does not explain; NaN counts as infinite."""
        value = value - self.sigmas * error
        return value if np.isfinite(value) else np.inf
