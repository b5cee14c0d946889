"""Clusters of the position-normal manifold: their normals and how far they are from the map's.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.2, Eq. 7 and 8. A cluster of level l takes the place
of 2^l × 2^l quads by two triangles, whose vertex normals n_0^l…n_3^l are the least-squares fit

    argmin ∫ ‖n^l(u/2^l) − n(u)‖² / |det J(u)| du.                                       (Eq. 7)

Over a triangle of the map the integrand is a quadratic polynomial, and the diagonals of clusters
and quads align, so that every triangle of the map lies in one half of the cluster. Its integral is
thus exact by the rule of the three midpoints of edges, and a cluster needs only the moments, up to
the second, of the map over its two halves; those of a parent are sums of its children's, so that
all levels together cost little more than the first. NumPy, float64; no Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Quads in a strip whose moments are held at once, 208 bytes each.
STRIP_QUADS = 1 << 18

#: Added to the diagonal of A, relative to its mean, against singular systems. The true A has none:
#: every triangle has a weight > 0; but weights may differ by more than float64 can tell.
RIDGE = 1e-12

#: Moments of one half of a cluster, weighted by 1/|det J|, about its corner n_0 and in units of its
#: side: of 1, x, y, x², xy, y²; of n_x, n_y times 1, x and y each; of ‖n‖². All per texel².
MOMENTS = 6 + 3 * 2 + 1

#: Where the products of 1, x, y with one another stand among the moments.
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
    ``epsilon`` is the least |det J|. Yields, for every level, arrays over its ⌊R/2^l⌋ × ⌊C/2^l⌋
    whole clusters: the normals n_0^l…n_3^l, (…, 4, 2), and the residuals e^l.

    The residual of the solved normal equations, which Eq. 8 prints, is 0 but for rounding. What is
    returned is the integral that Eq. 7 minimises, at its minimum, in texels⁴: |det J| being the
    area of normals per texel, ‖n^l − n‖²/|det J| is, to first order, the squared distance (texels²)
    between the places at which the cluster and the map show a normal, and the integral runs over
    the cluster's texels.
    """
    vertices = np.asarray(vertices, np.float64)
    mean = vertices.mean((0, 1))  # taken out, so that ‖n‖² has digits left for the residual
    moments = first_moments(vertices - mean, epsilon)
    for level in range(1, levels + 1):
        if level > 1:
            moments = merged(moments)
        normals, residual = solve(moments)
        yield (normals + mean).astype(np.float32), residual.astype(np.float32)


def first_moments(vertices: Array, epsilon: float) -> Array:
    """Moments of the clusters of level 1, (⌊R/2⌋, ⌊C/2⌋, 2 halves, MOMENTS)."""
    rows, columns = ((n - 1) // 2 for n in vertices.shape[:2])
    step = max(1, STRIP_QUADS // (4 * max(columns, 1)))
    strips = [
        merged(quad_moments(vertices[2 * i : 2 * min(i + step, rows) + 1], epsilon))
        for i in range(0, rows, step)
    ]
    return np.concatenate([np.empty((0, columns, 2, MOMENTS)), *strips])


def quad_moments(vertices: Array, epsilon: float) -> Array:
    """Moments of every quad, (R, C, 2 halves, MOMENTS)."""
    n0, n1 = vertices[:-1, :-1], vertices[:-1, 1:]
    n2, n3 = vertices[1:, :-1], vertices[1:, 1:]
    moments = np.zeros((*n0.shape[:2], 2, MOMENTS))
    for half, (a, b, c) in enumerate(((n0, n1, n2), (n3, n2, n1))):
        det = np.cross(b - a, c - a)
        weight = (0.5 / 3) / np.maximum(np.abs(det), epsilon)  # of a midpoint: a third of the area
        corners = (((0, 0), a), ((1, 0), b), ((0, 1), c))
        for k in range(3):
            (p, n_p), (q, n_q) = corners[k], corners[k - 1]
            x, y = (p[0] + q[0]) / 2, (p[1] + q[1]) / 2
            x, y = (1 - x, 1 - y) if half else (x, y)
            n = 0.5 * (n_p + n_q)
            moments[:, :, half, :6] += weight[..., None] * [1, x, y, x * x, x * y, y * y]
            for axis in range(2):
                weighted = weight * n[..., axis]
                moments[:, :, half, 6 + 3 * axis : 9 + 3 * axis] += weighted[..., None] * [1, x, y]
            moments[:, :, half, -1] += weight * (n * n).sum(-1)
    return moments


def seen_from_parent(x: int, y: int) -> Array:
    """Matrix (MOMENTS, MOMENTS) from moments of a child at (x, y) ∈ {0, 1}² to its parent's."""
    # (1, x, y) of the parent in terms of those of the child, and the same for their products.
    first = np.array([[1, 0, 0], [x / 2, 0.5, 0], [y / 2, 0, 0.5]])
    matrix = np.zeros((MOMENTS, MOMENTS))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        np.add.at(matrix[PRODUCTS[i, j]], PRODUCTS.ravel(), np.outer(first[i], first[j]).ravel())
    matrix[6:9, 6:9] = matrix[9:12, 9:12] = first
    matrix[-1, -1] = 1
    return matrix


def merged(moments: Array) -> Array:
    """Moments of the clusters of the next level; a last odd row or column is left out."""
    rows, columns = (n // 2 for n in moments.shape[:2])
    child = {
        (x, y): moments[y : 2 * rows : 2, x : 2 * columns : 2] @ seen_from_parent(x, y).T
        for x in (0, 1)
        for y in (0, 1)
    }
    # The parent's diagonal runs along those of its right upper and its left lower child.
    halves = child[1, 0] + child[0, 1]
    halves[:, :, 0] += child[0, 0].sum(2)
    halves[:, :, 1] += child[1, 1].sum(2)
    return halves


def solve(moments: Array) -> tuple[Array, Array]:
    """Least-squares normals (…, 4, 2) and residuals (…) of clusters, from their moments (Eq. 8)."""
    A = np.einsum("hip,...hpq,hjq->...ij", PHI, moments[..., PRODUCTS], PHI, optimize=True)
    first = moments[..., 6:12].reshape(*moments.shape[:-1], 2, 3)
    b = np.einsum("hip,...hap->...ia", PHI, first, optimize=True)
    square = moments[..., -1].sum(-1)

    # About the cluster's mean normal; the weights of n_0…n_3 sum to 1 everywhere.
    mass = moments[..., 0].sum(-1)[..., None]
    mean = first[..., 0].sum(-2) / mass
    b -= A.sum(-1)[..., None] * mean[..., None, :]
    square = square - mass[..., 0] * (mean * mean).sum(-1)

    A_ridge = A + (RIDGE / 4) * np.trace(A, axis1=-2, axis2=-1)[..., None, None] * np.eye(4)
    deviation = np.linalg.solve(A_ridge, b)
    residual = square + ((A @ deviation - 2 * b) * deviation).sum((-2, -1))
    return deviation + mean[..., None, :], np.maximum(residual, 0)
