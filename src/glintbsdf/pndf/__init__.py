"""Estimators of the P-NDF, the distribution of normals seen through a footprint."""

from .clustered import ClusteredManifold
from .elements import Elements
from .filtered import Filtered
from .flakes import Flakes
from .grid import Grid
from .hand_over import HandOver
from .manifold import Manifold
from .mip import Mip
from .tabulated import TabulatedManifold

__all__ = [
    "ClusteredManifold",
    "Elements",
    "Filtered",
    "Flakes",
    "Grid",
    "HandOver",
    "Manifold",
    "Mip",
    "TabulatedManifold",
]
