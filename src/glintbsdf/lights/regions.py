"""Bright regions of an environment, cut out as small lights.

The sun of a captured environment, or of ``sunsky``, is a light like any other, but its emitter
is the whole environment. Here its directions become a light of their own, an ellipse on the sphere
of directions that is sampled at every hit, and that a P-NDF integrates
(:mod:`~glintbsdf.lights.small`). The rest is the environment without these directions.
Radiance is always that of the environment, so the two add up to it wherever the ellipses are.

Regions are found from samples of the emitter, so any environment will do. An environment whose
brightest directions are not much brighter than its mean has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.hashing import LATTICE_STEPS
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import stored
from glintbsdf.lights.view import MAX_DEVIATION, View

#: Number of samples of an environment in which regions are searched.
SAMPLES = 1 << 14

#: Largest number of regions.
MAX_REGIONS = 16

#: Least radiance of a bright direction, over the mean radiance of all directions: that of a disk of
#: the radius 2 :data:`MAX_DEVIATION`, if all light comes from it. Softboxes are larger or dimmer.
#: They make more noise as regions, as the BSDF samples them well.
BRIGHT = 1 / np.sin(MAX_DEVIATION) ** 2

#: Least share of the noise of the environment, ∫L² dω, that is worth a region.
LEAST_SHARE = 1 / 16

#: Least radiance in a region, over the mean radiance of what it is cut from.
LEAST_RADIANCE = 0.1

#: Least number of samples that show where a region is.
LEAST_SAMPLES = 32

#: Neighbours of each sample, and largest distance of a neighbour over the spacing of samples: so
#: uniform samples are connected.
NEIGHBOURS, REACH = 8, 2.0

#: Half axes of an ellipse over its standard deviations: 2 for a uniform ellipse, more if light
#: comes from farther out.
LEAST_SCALE, LARGEST_SCALE = 2.0, 3.0

#: Samples in a region are drawn from a table of so many cells along each axis of a square. Its
#: radiance is measured at so many points along each axis of a cell.
CELLS, CELL_POINTS = 16, 4

#: Share of the samples in a region that are uniform, for light that the table misses.
UNIFORM_SHARE = 0.1

#: Least half axis of a region (radians): single precision resolves it.
LEAST_HALF_AXIS = 1e-4

#: Least ratio of (mean radiance)² and mean of radiance², in a region that counts as uniform.
LEAST_UNIFORMITY = 0.8

#: Wavelengths (nm) at which spectral radiance is compared.
WAVELENGTHS = (460.0, 530.0, 580.0, 630.0)


@dataclass(frozen=True)
class Region:
    """An elliptic region of directions, in float64.

    It contains the unit directions ω with ω·d > 0 and (ω·x/a)² + (ω·y/b)² < 1.

    Attributes:
        axes (np.ndarray): the unit vectors x, y and d (the rows, 3×3), d to its centre.
        half_axes (np.ndarray): a and b (2).
        variances (np.ndarray): of ω·x and ω·y (2), weighted by radiance.
        elliptic (bool): whether radiance is about the same in the whole region.
    """

    axes: np.ndarray
    half_axes: np.ndarray
    variances: np.ndarray
    elliptic: bool

    def contains(self, directions: np.ndarray) -> np.ndarray:
        """Whether the region contains each of the ``directions`` (N, 3)."""
        x, y, z = self.axes @ directions.T
        return (z > 0) & ((x / self.half_axes[0]) ** 2 + (y / self.half_axes[1]) ** 2 < 1)


def find_regions(
    directions: np.ndarray, radiance: np.ndarray, solid_angle: np.ndarray
) -> list[Region]:
    """The regions to cut out of an environment, those that make most noise first.

    Args:
        directions: samples of the environment, unit vectors (N, 3).
        radiance: radiance from there (N).
        solid_angle: what each sample stands for, 1/(N·density) (N), steradians.
    """
    regions: list[Region] = []
    power = radiance * solid_angle
    candidates = power > 0
    while len(regions) < MAX_REGIONS:
        mean = power.sum() / (4 * np.pi)
        bright = np.flatnonzero(candidates & (radiance > BRIGHT * mean))
        noise = power * radiance
        part = noisiest_part(directions, solid_angle, noise, bright)
        if noise[part].sum() <= LEAST_SHARE * noise.sum():
            break
        # A sun has a halo: what the part's light mostly comes from is the region.
        least = LEAST_RADIANCE * noise[part].sum() / power[part].sum()
        part = part[radiance[part] > least]
        part = noisiest_part(directions, solid_angle, noise, part)
        region = fitted(directions[part], radiance[part], power[part])
        candidates[part] = False
        if region is not None:
            regions.append(region)
            inside = region.contains(directions)
            candidates[inside], power[inside] = False, 0
    return regions


def noisiest_part(
    directions: np.ndarray, solid_angle: np.ndarray, noise: np.ndarray, members: np.ndarray
) -> np.ndarray:
    """Of the samples ``members`` (indices), the connected ones that have most ``noise`` together.

    Samples are connected if they are neighbours, and not much farther from each other than samples
    of their density are.
    """
    if len(members) <= 1:
        return members
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(members)
    distance, neighbour = KDTree(directions[members]).query(
        directions[members], k=range(2, 2 + min(NEIGHBOURS, count - 1))
    )
    near = distance < REACH * np.sqrt(solid_angle[members])[:, None]
    row, column = np.nonzero(near)[0], neighbour[near]
    graph = coo_matrix((np.ones(len(row), bool), (row, column)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return members[label == np.argmax(np.bincount(label, noise[members]))]


def fitted(directions: np.ndarray, radiance: np.ndarray, power: np.ndarray) -> Region | None:
    """The region of samples: ``directions`` (N, 3), ``radiance`` (N), and ``power`` (N).

    None if there are too few samples, or if the region would not be small.
    """
    if len(directions) < LEAST_SAMPLES:
        return None
    weights = power / power.sum()
    mean = weights @ directions
    d = mean / np.linalg.norm(mean)
    across = np.linalg.svd(d[None])[2][1:]  # two unit vectors
    offsets = directions @ across.T  # their mean is 0
    values, vectors = np.linalg.eigh((offsets.T * weights) @ offsets)
    offsets, across = offsets @ vectors, vectors.T @ across
    variances = np.maximum(values, (LEAST_HALF_AXIS / LEAST_SCALE) ** 2)
    if variances.max() >= MAX_DEVIATION**2 or np.min(directions @ d) <= 0:
        return None
    reach = np.sqrt((offsets**2 / variances).sum(1).max())
    half_axes = np.sqrt(variances) * np.clip(1.01 * reach, LEAST_SCALE, LARGEST_SCALE)
    inside = (offsets**2 / half_axes**2).sum(1) < 1
    total = power[inside].sum()
    area = np.pi * half_axes.prod()
    uniformity = total**2 / (area * (power * radiance)[inside].sum())
    axes = np.stack([*across, d])
    return Region(axes, half_axes, variances, bool(uniformity > LEAST_UNIFORMITY))


def observer() -> mi.Interaction3f:
    """A point from which the radiance of an environment is compared."""
    it = dr.zeros(mi.Interaction3f)
    if mi.is_spectral:
        it.wavelengths = type(it.wavelengths)(*WAVELENGTHS)
    return it


def mean_over_colours(spectrum: mi.Spectrum, count: int) -> np.ndarray:
    """The mean over the channels of each of ``count`` spectra, or of one for all (N)."""
    channels = np.array(mi.unpolarized_spectrum(spectrum), np.float64)
    return np.broadcast_to(channels.reshape(len(channels), -1).mean(0), count)


def samples_of(environment: mi.Emitter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of an environment, as :func:`find_regions` takes them. Radiance is the mean over
    colours; samples whose values are not finite are black."""
    # A low-discrepancy sequence leaves no gaps.
    random = (0.5 + np.outer(LATTICE_STEPS, np.arange(SAMPLES))) % 1
    random = np.minimum(random.astype(np.float32), np.float32(1 - 2**-24))
    with dr.suspend_grad():
        ds, weight = environment.sample_direction(observer(), mi.Point2f(random))
        power = mean_over_colours(weight, SAMPLES) / SAMPLES
        directions = np.array(ds.d, np.float64).T
        pdf = np.broadcast_to(np.array(ds.pdf, np.float64), SAMPLES)
    usable = np.isfinite(power) & np.isfinite(pdf) & (pdf > 0) & (power > 0)
    usable &= np.isfinite(directions).all(1)
    solid_angle = 1 / (SAMPLES * pdf[usable])
    return directions[usable], power[usable] / solid_angle, solid_angle


def cumulative(radiance: np.ndarray) -> np.ndarray:
    """The cumulative probabilities (regions, cells) to draw samples with, for the mean ``radiance``
    (regions, cells) of cells of equal areas."""
    radiance = np.maximum(radiance, 0)
    mean = radiance.mean(1, keepdims=True)
    weights = np.where(mean > 0, (1 - UNIFORM_SHARE) * radiance + UNIFORM_SHARE * mean, 1)
    result = np.cumsum(weights, axis=1)
    return (result / result[:, -1:]).astype(np.float32)


class BrightRegions:
    """Bright regions of an environment, as lights that are sampled at every hit.

    Where regions overlap, directions belong to the first one.

    Args:
        scene (mi.Scene): the scene, whose bounds say how far the environment is.
        environment (mi.EmitterPtr): its environment.
        regions (list[Region]): the regions.

    Attributes:
        count (mi.UInt32): number of regions.
    """

    def __init__(self, scene: mi.Scene, environment: mi.EmitterPtr, regions: list[Region]) -> None:
        self.environment, self.count = environment, dr.opaque(mi.UInt32, len(regions))
        bounds = scene.bbox().bounding_sphere()
        self.middle, self.radius = mi.Point3f(bounds.center), mi.Float(bounds.radius)
        dr.make_opaque(self.middle, self.radius)

        def numbers(name: str) -> mi.Float:
            values = [getattr(region, name) for region in regions]
            return stored(mi.Float, np.array(values, np.float32).ravel())

        self.axes, self.half_axes = numbers("axes"), numbers("half_axes")
        self.variances, self.elliptic = numbers("variances"), numbers("elliptic")
        self.cumulative = stored(mi.Float, cumulative(self.measured(len(regions))).ravel())

    def measured(self, regions: int) -> np.ndarray:
        """The mean radiance (regions, cells) of each cell of each region."""
        side = CELLS * CELL_POINTS
        index = dr.arange(mi.UInt32, regions * side**2)
        k, row, column = index // side**2, index // side % side, index % side
        square = (mi.Point2f(column, row) + 0.5) / side
        with dr.suspend_grad():
            d, _ = self.direction(k, square, mi.Bool(True))
            radiance = self.radiance(d, observer(), mi.Bool(True))
            values = mean_over_colours(radiance, len(index))
        values = np.nan_to_num(values, posinf=0, neginf=0)
        cells = values.reshape(regions, CELLS, CELL_POINTS, CELLS, CELL_POINTS).mean((2, 4))
        return cells.reshape(regions, -1)

    def local(self, k: mi.UInt32, d: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """The unit direction ``d`` along the axes of region ``k``, in units of its half axes; z
        is the cosine of its angle with the centre."""
        half_axes = dr.gather(mi.Vector2f, self.half_axes, k, active)
        x, y, z = (dr.dot(d, axis) for axis in self.frame(k, active))
        return mi.Vector3f(x / half_axes.x, y / half_axes.y, z)

    def frame(self, k: mi.UInt32, active: mi.Bool) -> list[mi.Vector3f]:
        """The axes x, y and d of region ``k``."""
        return [dr.gather(mi.Vector3f, self.axes, 3 * k + row, active) for row in range(3)]

    def region_of(self, d: mi.Vector3f, active: bool | mi.Bool = True) -> mi.UInt32:
        """The region that the unit direction ``d`` belongs to; ``count`` if it belongs to none."""
        with dr.suspend_grad():
            d, active = mi.Vector3f(d), mi.Bool(active)

            def search(k, found):
                local = self.local(k, d, active)
                found = (local.z > 0) & (dr.square(local.x) + dr.square(local.y) < 1)
                return dr.select(found, k, k + 1), found

            return symbolic_loop(
                (mi.UInt32(0), ~active),
                lambda k, found: ~found & (k < self.count),
                search,
                label="regions",
            )[0]

    def contain(self, d: mi.Vector3f, active: bool | mi.Bool = True) -> mi.Bool:
        """Whether a region contains the unit direction ``d``."""
        return active & (self.region_of(d, active) < self.count)

    def sample_direction(
        self, k: mi.UInt32, it: mi.Interaction3f, random: mi.Point2f, active: bool | mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction in region ``k``, and its radiance over its density, as
        ``mi.Emitter.sample_direction`` returns them. Density and weight are 0 for directions that
        belong to another region."""
        place, probability = self.sample_cell(k, random, active)
        d, pdf = self.direction(k, place, active)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(d))
        ds.d, ds.n = d, mi.Normal3f(-d)
        ds.dist = 2 * dr.maximum(self.radius, dr.norm(it.p - self.middle))  # type: ignore[assignment]
        ds.p = it.p + d * ds.dist
        ds.time = it.time
        ds.emitter = self.environment
        active = active & (self.region_of(d, active) == k)
        ds.pdf = dr.select(active, pdf * probability * CELLS**2, 0)  # type: ignore[assignment]
        return ds, dr.select(active, self.radiance(d, it, active) / ds.pdf, 0)

    def sample_cell(
        self, k: mi.UInt32, random: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Point2f, mi.Float]:
        """A point in the unit square, in a cell that is drawn from the table of region ``k``, and
        the probability of the cell."""
        first = k * CELLS**2

        def value(index):
            return dr.gather(mi.Float, self.cumulative, first + index, active)

        cell = dr.binary_search(0, CELLS**2 - 1, lambda index: value(index) <= random.x)
        lower = dr.select(cell > 0, value(dr.maximum(cell, 1) - 1), 0)
        probability = value(cell) - lower
        x = dr.clip((random.x - lower) / probability, 0, 1 - 2**-24)
        row, column = cell // CELLS, cell % CELLS
        return mi.Point2f(column + x, row + random.y) / CELLS, probability

    def direction(
        self, k: mi.UInt32, square: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float]:
        """The direction in region ``k`` for a point of the unit square, and the density (1/sr) of
        the directions for uniform points."""
        disk = mi.warp.square_to_uniform_disk_concentric(square)
        half_axes = dr.gather(mi.Vector2f, self.half_axes, k, active)
        x, y = disk.x * half_axes.x, disk.y * half_axes.y
        z = dr.safe_sqrt(1 - x * x - y * y)
        axis_x, axis_y, axis_z = self.frame(k, active)
        d = dr.normalize(axis_x * x + axis_y * y + axis_z * z)
        return d, z / (dr.pi * half_axes.x * half_axes.y)

    def radiance(self, d: mi.Vector3f, it: mi.Interaction3f, active: mi.Bool) -> mi.Spectrum:
        """Radiance of the environment from the direction ``d``."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
        si.wi, si.time, si.wavelengths = -d, it.time, it.wavelengths
        return self.environment.eval(si, active)

    def view(self, k: mi.UInt32, active: bool | mi.Bool = True) -> View:
        """Region ``k`` as it is seen from everywhere."""
        x, y, d = self.frame(k, active)
        variances = dr.gather(mi.Vector2f, self.variances, k, active)
        elliptic = dr.gather(mi.Float, self.elliptic, k, active) != 0
        return View(d, x, y, variances.x, variances.y, mi.Bool(active), elliptic)
