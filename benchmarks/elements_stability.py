"""One element in float32: Yan16's appendix against the form that is used here.

``python benchmarks/elements_stability.py [--count 20000] [-o RESULT.json]``

Random footprints (0.05 to 10 steps, up to 10:1, rotated), seeds under them, Jacobians with entries
up to |J| per step, and normals drawn from the element as the footprint sees it. Both forms compute
in float32 from the same float32 numbers; the truth is the definition in float64. Printed are the
median and the worst relative error, NaN and infinite values as such.

The appendix stores inverse covariances, whose entries grow like 1/σ_r², slices, multiplies and
integrates Gaussians (Eq. 15 to 21). Expected before measuring (an earlier prototype): worst errors
of 0.2 at σ_r = 1e-3, |J| = 1, all digits lost at 1e-4, overflow at 1e-5; against 3e-4 for ours.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from _common import save_results  # noqa: E402

from glintbsdf.pndf.gaussian_elements import SIGMA_H, Gaussian, Overlap  # noqa: E402

Array = np.ndarray


def inverse(m: Array) -> Array:
    """Inverses of 2×2 matrices (…, 2, 2) in their own precision."""
    determinant = m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]
    adjugate = np.stack([m[..., 1, 1], -m[..., 0, 1], -m[..., 1, 0], m[..., 0, 0]], -1)
    return adjugate.reshape(m.shape) / determinant[..., None, None]


def determinant(m: Array) -> Array:
    return m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]


def form(matrix: Array, v: Array) -> Array:
    return np.einsum("ni,nij,nj->n", v, matrix, v)


def appendix(d: Array, s: Array, jacobian: Array, sigma_p: Array, sigma_r: float) -> Array:
    """The integral of Eq. 11 by the paper's appendix, in the precision of ``d``.

    ``d``: from the element's seed to the footprint's centre; ``s``: normal less that of the seed.
    """
    kind = d.dtype.type
    sigma_h, sigma_r = kind(SIGMA_H), kind(sigma_r)
    eye = np.eye(2, dtype=kind)
    transposed = jacobian.transpose(0, 2, 1)
    a = eye / sigma_h**2 + transposed @ jacobian / sigma_r**2  # Eq. 14, blocks of Eq. 15
    b, c = -transposed / sigma_r**2, eye / sigma_r**2
    u = -np.einsum("nij,njk,nk->ni", inverse(a), b, s)  # Eq. 18
    slice_form = np.einsum("ni,ij,nj->n", s, c, s) - form(a, u)
    scale = np.exp(kind(-0.5) * slice_form) / (kind(4 * np.pi**2) * sigma_h**2 * sigma_r**2)
    precision_p = inverse(sigma_p)
    covariance = inverse(a + precision_p)  # Eq. 19
    right = np.einsum("nij,nj->ni", a, u) + np.einsum("nij,nj->ni", precision_p, d)
    mean = np.einsum("nij,nj->ni", covariance, right)
    scale_p = 1 / (kind(2 * np.pi) * np.sqrt(determinant(sigma_p)))
    product = (  # Eq. 20
        scale
        * np.exp(kind(-0.5) * form(a, mean - u))
        * scale_p
        * np.exp(kind(-0.5) * form(precision_p, mean - d))
    )
    return product * kind(2 * np.pi) * np.sqrt(determinant(covariance))  # Eq. 21


def ours(d: Array, s: Array, jacobian: Array, axes: Array, sigma_r: float) -> Array:
    """The same by ``gaussian_elements.py``; ``axes`` (N, 2, 2): those of the footprint."""
    footprint = Gaussian(tuple(mi.Vector2f(axes[:, k].T) for k in range(2)))
    overlap = Overlap(footprint, Gaussian(variance=SIGMA_H**2))
    j = mi.Matrix2f(np.ascontiguousarray(jacobian.transpose(1, 2, 0)))
    normals = overlap.normals(j, Gaussian(variance=float(np.float32(sigma_r)) ** 2))
    offset = mi.Vector2f(d.T)
    delta = mi.Vector2f(s.T) - j @ overlap.mean(offset)
    return (overlap.mass(offset) * normals.eval(delta)).numpy()


def elements(count: int, slope: float, sigma_r: float, rng) -> tuple:
    """Random elements in float32, and the exact value of each in float64."""
    angle = rng.uniform(0, 2 * np.pi, count)
    major = 10 ** rng.uniform(np.log10(0.05), 1, count)
    minor = major * 10 ** rng.uniform(-1, 0, count)
    axes = np.stack(
        [
            np.stack([major * np.cos(angle), major * np.sin(angle)], -1),
            np.stack([-minor * np.sin(angle), minor * np.cos(angle)], -1),
        ],
        1,
    ).astype(np.float32)
    jacobian = (slope * rng.uniform(-1, 1, (count, 2, 2))).astype(np.float32)
    j, f = jacobian.astype(np.float64), axes.astype(np.float64)
    sigma_r = float(np.float32(sigma_r))
    sigma_p = f.transpose(0, 2, 1) @ f
    t = sigma_p + SIGMA_H**2 * np.eye(2)

    def drawn(covariance):
        root = np.linalg.cholesky(covariance)
        return np.einsum("nij,nj->ni", root, rng.standard_normal((count, 2)))

    d = drawn(t).astype(np.float32)
    gain = SIGMA_H**2 * np.linalg.inv(t)
    covariance = sigma_r**2 * np.eye(2) + j @ gain @ sigma_p @ j.transpose(0, 2, 1)
    mean = np.einsum("nij,njk,nk->ni", j, gain, d.astype(np.float64))
    s = (mean + drawn(covariance)).astype(np.float32)

    def density(v, matrix):
        distance = form(np.linalg.inv(matrix), v)
        return np.exp(-0.5 * distance) / (2 * np.pi * np.sqrt(np.linalg.det(matrix)))

    exact = density(d.astype(np.float64), t) * density(s - mean, covariance)
    return d, s, jacobian, axes, exact


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    results = []
    print("sigma_r  |J|     appendix: median    worst    ours: median    worst")
    for sigma_r in (1e-2, 1e-3, 1e-4, 1e-5):
        for slope in (0.0, 0.01, 0.1, 1.0):
            rng = np.random.default_rng(1)
            d, s, jacobian, axes, exact = elements(options.count, slope, sigma_r, rng)
            sigma_p = (axes.transpose(0, 2, 1) @ axes).astype(np.float32)
            with np.errstate(all="ignore"):
                values = {
                    "appendix": appendix(d, s, jacobian, sigma_p, sigma_r),
                    "ours": ours(d, s, jacobian, axes, sigma_r),
                }
                errors = {k: np.abs(v.astype(np.float64) / exact - 1) for k, v in values.items()}
            row = {"sigma_r": sigma_r, "slope": slope}
            for name, error in errors.items():
                error = np.where(np.isfinite(error), error, np.inf)
                row[f"{name}_median"] = float(np.median(error))
                row[f"{name}_worst"] = float(error.max())
            results.append(row)
            print(
                f"{sigma_r:7.0e}  {slope:4g} {row['appendix_median']:18.1e}"
                f" {row['appendix_worst']:8.1e} {row['ours_median']:15.1e}"
                f" {row['ours_worst']:8.1e}"
            )
    if options.output:
        save_results(options.output, {"results": results})


if __name__ == "__main__":
    main()
