"""P-NDFs: estimators of the distribution of normals seen through a footprint."""

from glintbsdf.pndf.base import PNDF, methods, register
from glintbsdf.pndf.elements.elements import Elements
from glintbsdf.pndf.elements.flakes import Flakes
from glintbsdf.pndf.filters.filters import Filtered
from glintbsdf.pndf.filters.hand_over import HandOver
from glintbsdf.pndf.grid.microdetails import Grid
from glintbsdf.pndf.manifold.clustered import ClusteredManifold
from glintbsdf.pndf.manifold.exact import Manifold
from glintbsdf.pndf.manifold.tabulated import TabulatedManifold
from glintbsdf.pndf.mip.exact import Patches
from glintbsdf.pndf.mip.mip import Mip
from glintbsdf.pndf.particles.particles import Particles

__all__ = [
    "ClusteredManifold",
    "Elements",
    "Filtered",
    "Flakes",
    "Grid",
    "HandOver",
    "Manifold",
    "Mip",
    "Particles",
    "Patches",
    "TabulatedManifold",
    "PNDF",
    "methods",
    "register",
]
