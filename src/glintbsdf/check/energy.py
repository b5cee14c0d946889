"""Energy: the share of uniform light that a BSDF reflects at each place, and ray tracing of the
displaced surface.

The reference needs neither a P-NDF nor masking. A displaced height field of mirrors is a mesh of
triangles. A ray from the viewer hits a facet, and counts if its reflection leaves without hitting
the surface again. The share of such rays is the directional albedo of single scattering, which a
microfacet BRDF approximates. The BSDF gets the normal map of the same surface, and is evaluated at
random places, under footprints of a few texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check
from glintbsdf.maps.normalmap import NormalMap


@dataclass(frozen=True)
class Surface:
    """A periodic height field with Gaussian heights, autocorrelation exp(−(r/``length``)²).

    Args:
        size (int): texels along each axis.
        slope (float): standard deviation of the slope along each axis, of the continuous surface.
        length (float): correlation length, texels; waves shorter than 4 texels must be weak.
        seed (int): seed of the surface.
    """

    size: int = 256
    slope: float = 0.15
    length: float = 6.0
    seed: int = 0

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fourier coefficients of the heights, and the frequencies along y and x (rad/texel)."""
        y, x = (
            2 * np.pi * np.fft.fftfreq(self.size)[:, None],
            2 * np.pi * np.fft.fftfreq(self.size),
        )
        noise = np.random.default_rng(self.seed).standard_normal((self.size, self.size))
        waves = np.fft.fft2(noise) * np.exp(-(self.length**2) * (x**2 + y**2) / 8)
        squared_slope = np.mean(np.abs(waves) ** 2 * (x**2 + y**2)) / self.size**2
        return waves * (self.slope / np.sqrt(0.5 * squared_slope)), y, x

    def normal_map(self) -> NormalMap:
        """The exact normals of the surface at its texels."""
        waves, y, x = self.spectrum()
        gradient = np.stack([np.fft.ifft2(1j * k * waves).real for k in (x, y)], axis=2)
        normals = -gradient / np.sqrt(1 + (gradient**2).sum(axis=2, keepdims=True))
        return NormalMap(normals.astype(np.float32))

    def heights(self, refinement: int) -> np.ndarray:
        """Heights (texels) of one period, at ``refinement``² points per texel."""
        waves, _, _ = self.spectrum()
        fine = self.size * refinement
        padded = np.zeros((fine, fine), complex)
        index = np.fft.fftfreq(self.size, 1 / self.size).astype(int)
        padded[np.ix_(index, index)] = waves
        return np.fft.ifft2(padded).real * refinement**2

    def scene(self, refinement: int, border: float) -> mi.Scene:
        """The displaced surface as a mesh: one period, and ``border`` more texels on each side."""
        heights = self.heights(refinement)
        count = int(round((self.size + 2 * border) * refinement)) + 1
        index = np.arange(count) - round(border * refinement)
        z = heights[np.ix_(index % len(heights), index % len(heights))]
        x, y = np.meshgrid(index / refinement, index / refinement)
        first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
        corners = [first, first + 1, first + count, first + 1, first + count + 1, first + count]
        mesh = mi.Mesh("surface", count * count, 2 * len(first))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(
            np.stack([x, y, z], axis=2).astype(np.float32).ravel()
        )
        parameters["faces"] = mi.UInt32(np.stack(corners, axis=1).astype(np.uint32).ravel())
        parameters.update()
        return mi.load_dict({"type": "scene", "mesh": mesh})


def traced_energy(
    surface: Surface, angle: float, rays: int, refinement: int = 2, seed: int = 1
) -> float:
    """Share of the rays that leave the surface after one reflection.

    Args:
        surface: the surface.
        angle: angle of incidence, degrees; azimuths are random.
        rays: number of rays.
        refinement: vertices of the mesh per texel, along each axis.
        seed: seed of the rays.

    The mesh has half a period more on each side than the part that rays aim at. A reflected ray
    that is so flat that it reaches the border of the mesh counts as leaving.

    Raises:
        ParameterError: the angle is so grazing that rays miss the mesh.
    """
    border = 0.5 * surface.size
    scene = surface.scene(refinement, border)
    top = float(np.abs(surface.heights(refinement)).max()) + 1e-3
    rng = np.random.default_rng(seed)
    theta, phi = np.radians(angle), rng.uniform(0, 2 * np.pi, rays)
    sine = np.sin(theta)
    wi = mi.Vector3f(
        np.float32([sine * np.cos(phi), sine * np.sin(phi), np.full(rays, np.cos(theta))])
    )
    place = rng.uniform(0, surface.size, (2, rays)).astype(np.float32)
    aim = mi.Point3f(mi.Float(place[0]), mi.Float(place[1]), 0)
    si = scene.ray_intersect(mi.Ray3f(aim + wi * (top / float(np.cos(theta))), -wi))
    facing = dr.dot(mi.Vector3f(si.n), wi)
    wo = 2 * facing * mi.Vector3f(si.n) - wi
    leaves = si.is_valid() & (facing > 0) & (wo.z > 0)
    ray = si.spawn_ray(wo)
    leaves &= ~scene.ray_test(ray, leaves)
    met = np.array(si.is_valid())
    # A few rays may slip between two triangles.
    check(met.mean() > 1 - 1e-3, "traced_energy", "angle", "less grazing: rays miss", angle)
    return float(np.array(leaves)[met].mean())


def energies(
    bsdf: mi.BSDF, texels: int, sigma: float, angle: float, places: int, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """The share of uniform light that the BSDF reflects at random places, from random azimuths.

    Args:
        bsdf: the BSDF.
        texels (int): texels of its map along each axis.
        sigma (float): standard deviation of the round footprints, texels.
        angle (float): angle of incidence, degrees.
        places (int): number of places.
        samples (int): samples per place.

    Returns:
        The energy of each place, and its standard error.
    """
    rng = np.random.default_rng(2)
    uv, phi = rng.random((2, places)), rng.uniform(0, 2 * np.pi, places)
    sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.full(places, cosine)])
    si = dr.zeros(mi.SurfaceInteraction3f, places * samples)
    si.uv = mi.Point2f(np.float32(uv.repeat(samples, axis=1)))
    si.wi = mi.Vector3f(np.float32(wi.repeat(samples, axis=1)))
    si.duv_dx, si.duv_dy = mi.Vector2f(sigma / texels, 0), mi.Vector2f(0, sigma / texels)
    si.t, si.n, si.sh_frame = 1, mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    u = rng.random((3, places * samples)).astype(np.float32)
    _, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    weight = np.array(weight[0], np.float64).reshape(places, samples)
    return weight.mean(axis=1), weight.std(axis=1) / np.sqrt(samples)
