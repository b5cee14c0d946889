"""Figures of P-NDFs, footprints and errors; made in :mod:`glintbsdf.check.plot`."""

from glintbsdf.check.comparison import Comparison, compare
from glintbsdf.check.plot import errors, footprint, pndf

__all__ = ["Comparison", "compare", "errors", "footprint", "pndf"]
