"""Estimators of the P-NDF, the distribution of normals seen through a footprint."""

from .manifold import Manifold

__all__ = ["Manifold"]
