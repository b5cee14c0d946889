"""The binned reference of the P-NDF, in NumPy; it lives in :mod:`glintbsdf.check.reference`."""

from glintbsdf.check.reference import BinnedPNDF, binned_pndf, normal_bounds, texel_covariance

__all__ = ["BinnedPNDF", "binned_pndf", "normal_bounds", "texel_covariance"]
