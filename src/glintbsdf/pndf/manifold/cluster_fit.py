"""Clusters of the position-normal manifold: their normals, and their distance from the map.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.2, Eq. 7 and 8. A cluster of level l replaces
2^l × 2^l quads by two triangles, whose vertex normals n_0^l…n_3^l are the least-squares fit

    argmin ∫ ‖n^l(u/2^l) − n(u)‖² / |det J(u)| du.                                       (Eq. 7)

The diagonals of clusters and quads align, so every triangle of the map lies in one half of a
cluster. Over this triangle the integrand is a quadratic polynomial, and the values at the midpoints
of its edges give the exact integral. So a cluster needs only the moments, up to the second, of the
map over its two halves. The moments of a parent are sums of moments of its children, so that all
levels together cost little more than the first. Everything is NumPy in float64, without Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Number of quads in a strip, whose moments are in memory at the same time; each takes 208 bytes.
STRIP_QUADS = 1 << 18

#: Added to the diagonal of A, relative to its mean, against singular systems. The true A is
#: regular, as every triangle has a weight > 0. But weights may differ by more than float64
#: resolves.
RIDGE = 1e-12

#: Moments of one half of a cluster, weighted by 1/|det J|, about its corner n_0 and in units of its
#: side: of 1, x, y, x², xy, y²; of n_x, n_y times 1, x and y each; of ‖n‖². All per texel².
MOMENTS = 6 + 3 * 2 + 1

#: Indices, among the moments, of the products of 1, x, y with 1, x, y.
PRODUCTS = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])

#: Barycentric weights φ of n_0^l…n_3^l over the upper and the lower half, in terms of 1, x, y.
PHI = np.array(
    [
        [[1, -1, -1], [0, 1, 0], [0, 0, 1], [0, 0, 0]],
        [[0, 0, 0], [1, 0, -1], [1, -1, 0], [-1, 1, 1]],
    ],
    np.float64,
)


def fit_clusters(
    vertices: npt.ArrayLike, epsilon: float, levels: int
) -> Iterator[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Fit the clusters of the levels l = 1…``levels``, one level after the other.

    ``vertices`` (R + 1, C + 1, 2) are the projected normals at the corners of R×C quads;
    ``epsilon`` is the smallest |det J|. Yields, for every level, arrays over its ⌊R/2^l⌋ × ⌊C/2^l⌋
    whole clusters: the normals n_0^l…n_3^l, (…, 4, 2), and the residuals e^l.

    Eq. 8 prints the residual of the solved normal equations, which is 0 except for rounding. The
    residual that is returned is the minimum of the integral in Eq. 7, in texels⁴. Its integrand
    ‖n^l − n‖²/|det J| is, to first order, the squared distance (texels²) between the positions at
    which the cluster and the map show the same normal.
    """
    vertices = np.asarray(vertices, np.float64)
    mean = vertices.mean((0, 1))  # subtracted, so that ‖n‖² has digits left for the residual
    moments = first_moments(vertices - mean, epsilon)
    for level in range(1, levels + 1):
        if level > 1:
            moments = merged(moments)
        normals, residual = solve(moments)
        yield (normals + mean).astype(np.float32), residual.astype(np.float32)


def first_moments(vertices: Array, epsilon: float) -> Array:
    """Moments of the clusters of level 1, (MOMENTS, 2 halves, ⌊R/2⌋, ⌊C/2⌋)."""
    rows, columns = ((n - 1) // 2 for n in vertices.shape[:2])
    step = max(1, STRIP_QUADS // (4 * max(columns, 1)))
    strips = [
        merged(quad_moments(vertices[2 * i : 2 * min(i + step, rows) + 1], epsilon))
        for i in range(0, rows, step)
    ]
    return np.concatenate([np.empty((MOMENTS, 2, 0, columns)), *strips], axis=2)


def quad_moments(vertices: Array, epsilon: float) -> Array:
    """Moments of every quad, (MOMENTS, 2 halves, R, C)."""
    planes = np.ascontiguousarray(np.moveaxis(vertices, -1, 0))
    n0, n1 = planes[:, :-1, :-1], planes[:, :-1, 1:]
    n2, n3 = planes[:, 1:, :-1], planes[:, 1:, 1:]
    moments = np.empty((MOMENTS, 2, *n0.shape[1:]))
    for half, (a, b, c) in enumerate(((n0, n1, n2), (n3, n2, n1))):
        # The midpoints of the edges are (½, 0), (½, ½) and (0, ½) in the frame of a, b, c.
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        det = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        weight = (0.5 / 3) / np.maximum(np.abs(det), epsilon)  # a third of the area per midpoint
        for k, factor in enumerate((3, 1, 1, 0.5, 0.25, 0.5)):
            np.multiply(weight, factor, out=moments[k, half])
        for axis in range(2):
            moments[6 + 3 * axis, half] = weight * (ab[axis] + bc[axis] + ca[axis])
            moments[7 + 3 * axis, half] = weight * (0.5 * (ab[axis] + bc[axis]))
            moments[8 + 3 * axis, half] = weight * (0.5 * (bc[axis] + ca[axis]))
        moments[-1, half] = weight * (ab * ab + bc * bc + ca * ca).sum(0)
    moments[:, 1] = np.tensordot(TURNED, moments[:, 1], 1)
    return moments


def transformed(first: Array) -> Array:
    """Matrix (MOMENTS, MOMENTS) that takes moments from a source frame to a target frame.

    ``first`` (3, 3) expresses 1, x, y of the target frame by 1, x, y of the source frame.
    """
    matrix = np.zeros((MOMENTS, MOMENTS))
    for i, j in zip(*np.triu_indices(3), strict=True):
        np.add.at(matrix[PRODUCTS[i, j]], PRODUCTS.ravel(), np.outer(first[i], first[j]).ravel())
    matrix[6:9, 6:9] = matrix[9:12, 9:12] = first
    matrix[-1, -1] = 1
    return matrix


#: Transforms moments from the frame of n_3, n_2, n_1 to the frame of the quad.
TURNED = transformed(np.array([[1.0, 0, 0], [1, -1, 0], [1, 0, -1]]))


def merged(moments: Array) -> Array:
    """Moments of the clusters of the next level; a last odd row or column is left out."""
    rows, columns = (n // 2 for n in moments.shape[2:])

    def child(x, y):
        seen = transformed(np.array([[1, 0, 0], [x / 2, 0.5, 0], [y / 2, 0, 0.5]]))
        return np.tensordot(seen, moments[..., y : 2 * rows : 2, x : 2 * columns : 2], 1)

    # The parent's diagonal is made of the diagonals of its upper right and its lower left child.
    halves = child(1, 0) + child(0, 1)
    halves[:, 0] += child(0, 0).sum(1)
    halves[:, 1] += child(1, 1).sum(1)
    return halves


def solve(moments: Array) -> tuple[Array, Array]:
    """Least-squares normals (R, C, 4, 2) and residuals (R, C) of clusters (Eq. 8).

    ``moments``: (MOMENTS, 2 halves, R, C).
    """
    moments = np.moveaxis(moments, (0, 1), (-1, -2))
    A = np.einsum("hip,...hpq,hjq->...ij", PHI, moments[..., PRODUCTS], PHI, optimize=True)
    first = moments[..., 6:12].reshape(*moments.shape[:-1], 2, 3)
    b = np.einsum("hip,...hap->...ia", PHI, first, optimize=True)
    square = moments[..., -1].sum(-1)

    # Relative to the cluster's mean normal; the weights of n_0…n_3 sum to 1 everywhere.
    mass = moments[..., 0].sum(-1)[..., None]
    mean = first[..., 0].sum(-2) / mass
    b -= A.sum(-1)[..., None] * mean[..., None, :]
    square = square - mass[..., 0] * (mean * mean).sum(-1)

    A_ridge = A + (RIDGE / 4) * np.trace(A, axis1=-2, axis2=-1)[..., None, None] * np.eye(4)
    deviation = np.linalg.solve(A_ridge, b)
    residual = square + ((A @ deviation - 2 * b) * deviation).sum((-2, -1))
    return deviation + mean[..., None, :], np.maximum(residual, 0)
