"""Microstructure from photographs: what a flat sample is made of, from pictures under known lamps.

A camera looks straight down on a plate. One small lamp after the other shines on it; the first, a
flash, stands at the camera. From these photographs ``mi.ad.Adam`` recovers

* :func:`roughness_and_tint`: intrinsic roughness and colour of a surface whose bumps are known;
* :func:`flakes`: roughness and density of metallic flakes, none of which is where the truth has it;
* :func:`normal_map`: a normal map, from a flat start, coarse to fine.

Each makes its own photographs, of a truth that the optimiser is not told, with noise, and returns
figures by name. Run this file to see them all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import atan, degrees, exp, log, sqrt
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

DISTANCE = 16.0  # of camera and lamps, in half sides of the plate
NOISE = 0.02  # of a photograph, relative to its mean

# ----------------------------------------------------------------------------------------------
#  Photographs
# ----------------------------------------------------------------------------------------------


def lamps_around(normals: Sequence[tuple[float, float]]) -> list[list[float]]:
    """Places of lamps for which a facet with one of these projected normals, at the middle of the
    plate, is a mirror towards the camera."""
    return [[2 * DISTANCE * float(x), 2 * DISTANCE * float(y), DISTANCE] for x, y in normals]


def sample(bsdf: dict, pixels: int, filter_sigma: float = 0.0) -> mi.Scene:
    """A plate of this material under a camera with ``pixels``² pixels, and one lamp.

    ``filter_sigma``: standard deviation, in pixels, of what the film blurs by; 0 for a box.
    """
    blur = {"type": "gaussian", "stddev": filter_sigma} if filter_sigma else {"type": "box"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
            "sensor": {
                "type": "perspective",
                "fov": degrees(2 * atan(1 / DISTANCE)),
                "to_world": mi.ScalarTransform4f().look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": blur},
            },
            "plate": {"type": "rectangle", "bsdf": bsdf},
            "lamp": {"type": "point", "position": [0, 0, DISTANCE], "intensity": DISTANCE**2},
        }
    )


def glints(pixels: int, **parameters: object) -> dict:
    """A material whose footprints are those of this camera's pixels."""
    spread = 2 * atan(1 / DISTANCE) / pixels
    return {"type": "glint_elements", "pixel_spread": spread, **parameters}


class Photographer:
    """Takes pictures of a scene under lamps.

    Attributes:
        params: what ``mi.traverse`` finds; :meth:`name` tells the full name of a parameter.
    """

    def __init__(self, scene: mi.Scene, lamps: list[list[float]]) -> None:
        self.scene, self.lamps, self.params = scene, lamps, mi.traverse(scene)

    def name(self, ending: str) -> str:
        """The parameter whose name ends so."""
        return next(name for name in self.params.keys() if name.endswith(ending))

    def picture(self, lamp: int, spp: int, seed: int) -> mi.TensorXf:
        """One picture; derivatives flow to ``params``."""
        self.params["lamp.position"] = mi.Point3f(self.lamps[lamp])
        self.params.update()
        return mi.render(self.scene, self.params, spp=spp, seed=seed)

    def pictures(self, spp: int, seed: int = 0) -> list[np.ndarray]:
        """Pictures under all lamps."""
        return [self.picture(k, spp, seed + k).numpy() for k in range(len(self.lamps))]


def noisy(pictures: list[np.ndarray], seed: int = 7) -> list[mi.TensorXf]:
    """Photographs: pictures with a sensor's noise."""
    rng = np.random.default_rng(seed)
    return [
        mi.TensorXf((p + NOISE * p.mean() * rng.standard_normal(p.shape)).astype(np.float32))
        for p in pictures
    ]


def product(guess: Photographer, lamp: int, offset: object, spp: int, seed: int) -> tuple:
    """``(mean of picture, mean of (picture - offset)²)``, with derivatives, without a bias.

    The square of a picture has the square of its noise in it, which a rougher surface would lessen;
    the product of two pictures of the same thing has not. By symmetry, the derivative through one
    of the two is half of the product's.
    """
    picture = guess.picture(lamp, spp, seed)
    other = dr.detach(guess.picture(lamp, spp, seed + 10**6))
    product = dr.mean((picture - offset) * (other - offset))
    return dr.mean(picture), 2 * product - dr.detach(product)


def difference(pictures: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """Root mean square difference, relative to the truth's root mean square."""
    squares = [(np.mean((p - t) ** 2), np.mean(t**2)) for p, t in zip(pictures, truth, strict=True)]
    return float(np.sqrt(np.sum(squares, axis=0)[0] / np.sum(squares, axis=0)[1]))


# ----------------------------------------------------------------------------------------------
#  (a) Roughness and tint
# ----------------------------------------------------------------------------------------------


def roughness_and_tint(steps: int = 80, pixels: int = 64) -> dict[str, float]:
    """Intrinsic roughness σ_r and colour of a surface of known bumps, from a flash and 3 lamps."""
    start = time.time()
    bumps = mi.TensorXf(glintbsdf.maps.isotropic(64, alpha=0.12, correlation_length=5).normals)
    lamps = lamps_around([(0, 0), (0.1, 0), (-0.05, 0.09), (-0.05, -0.09)])

    def photographer(sigma_r: float, tint: list[float]) -> Photographer:
        tint_texture = {"type": "rgb", "value": tint}
        material = glints(pixels, data=bumps, sigma_r=sigma_r, specular_reflectance=tint_texture)
        return Photographer(sample(material, pixels), lamps)

    truth = {"sigma_r": 0.04, "tint": np.array([0.9, 0.6, 0.3])}
    photographs = noisy(photographer(0.04, [0.9, 0.6, 0.3]).pictures(spp=64))

    guess = photographer(0.1, [0.5, 0.5, 0.5])
    roughness, tint = guess.name("sigma_r"), guess.name("specular_reflectance.value")
    # A roughness is positive: its logarithm may be anything.
    optimizer = mi.ad.Adam(lr=0.08, params={"log": mi.Float(log(0.1)), "tint": mi.Color3f(0.5)})
    for step in range(steps):
        optimizer.set_learning_rate(0.08 * 0.03 ** (step / steps))
        # Steps that leave the range raise an error; a projection brings them back beforehand.
        optimizer["tint"] = dr.clip(optimizer["tint"], 0, 1)
        guess.params[roughness] = dr.exp(optimizer["log"])
        guess.params[tint] = optimizer["tint"]
        lamp = step % len(lamps)
        _, error = product(guess, lamp, photographs[lamp], spp=4, seed=step)
        dr.backward(error / dr.mean(dr.square(photographs[lamp])))
        optimizer.step()
    sigma_r, colour = exp(optimizer["log"][0]), np.array(optimizer["tint"]).ravel()
    return {
        "roughness": sigma_r,
        "error of roughness": abs(sigma_r / truth["sigma_r"] - 1),
        "error of tint": float(np.abs(colour / truth["tint"] - 1).max()),
        "seconds": time.time() - start,
    }


# ----------------------------------------------------------------------------------------------
#  (b) Flakes
# ----------------------------------------------------------------------------------------------


def flakes(steps: int = 100, pixels: int = 64) -> dict[str, float]:
    """Roughness and density of flakes, from statistics of a flash and 11 lamps.

    No flake of the guess is where the truth has one, so pictures cannot be compared pixel by pixel.
    The mean of a picture tells the roughness. The fewer flakes there are to a pixel, the more one
    pixel differs from the next: the mean square tells the density.
    """
    start = time.time()
    angles = np.arange(11) * 2 * np.pi / 11
    radii = [0.05, 0.1, 0.15, 0.2]
    lamps = lamps_around([(0, 0), *((radii[k % 4] * np.cos(a), radii[k % 4] * np.sin(a))
                                    for k, a in enumerate(angles))])  # fmt: skip

    def photographer(alpha: float, density: float, seed: int) -> Photographer:
        material = glints(pixels, flake_alpha=alpha, flake_density=density, sigma_r=0.06, seed=seed)
        return Photographer(sample(material, pixels), lamps)

    truth = {"alpha": 0.15, "density": 2500.0}
    photographs = noisy(photographer(0.15, 2500.0, seed=1).pictures(spp=64))
    # What noise adds to the mean square is known.
    means = [float(dr.mean(p).array[0]) for p in photographs]
    squares = [float(dr.mean(p * p).array[0]) - (NOISE * m) ** 2
               for p, m in zip(photographs, means, strict=True)]  # fmt: skip

    guess = photographer(0.3, 1000.0, seed=2)
    alpha, density = guess.name("flake_alpha"), guess.name("flake_density")
    optimizer = mi.ad.Adam(
        lr=0.05, params={"alpha": mi.Float(log(0.3)), "density": mi.Float(log(1000.0))}
    )
    found = []
    for step in range(steps):
        optimizer.set_learning_rate(0.08 * 0.1 ** (step / steps))
        guess.params[alpha] = dr.exp(optimizer["alpha"])
        guess.params[density] = dr.exp(optimizer["density"])
        lamp = step % len(lamps)
        mean, square = product(guess, lamp, 0, spp=8, seed=step)
        contrast = square / dr.square(mean) / (squares[lamp] / means[lamp] ** 2)
        dr.backward(dr.square(dr.log(mean / means[lamp])) + dr.square(dr.log(contrast)))
        optimizer.step()
        found.append([optimizer["alpha"][0], optimizer["density"][0]])
    # Every density has other flakes: the last half of the steps averages over many.
    alpha, density = np.exp(np.mean(found[len(found) // 2 :], axis=0))
    return {
        "flake_alpha": float(alpha),
        "error of flake_alpha": float(abs(alpha / truth["alpha"] - 1)),
        "flake_density": float(density),
        "error of flake_density": float(abs(density / truth["density"] - 1)),
        "seconds": time.time() - start,
    }


# ----------------------------------------------------------------------------------------------
#  (c) A normal map
# ----------------------------------------------------------------------------------------------

TEXELS, ROUGHNESS = 64, 0.03

#: Weight of the square of a normal's projection, beside that of the logarithm of brightness.
PRIOR = 5.0

#: A pixel and the footprint around each place in it, together: standard deviation, pixels.
BLUR = sqrt(0.5**2 + 1 / 12)


class Stage(NamedTuple):
    """Texels along a side of what is optimised, roughness of the material, steps, and their size at
    the beginning and at the end."""

    texels: int
    roughness: float
    steps: int
    first: float
    last: float


COARSE_TO_FINE = (
    Stage(16, 0.06, 40, 0.02, 0.008),
    Stage(32, 0.045, 40, 0.015, 0.005),
    Stage(64, ROUGHNESS, 60, 0.008, 0.001),
)


def lit(scene: mi.Scene, lamps: list[list[float]], spp: int, blur: float, seed: int) -> mi.TensorXf:
    """Pictures under all lamps at once, (lamps, pixels, pixels), by the BSDF itself.

    A rendering has one lamp. This evaluates the BSDF at ``spp`` places of every pixel, spread by
    ``blur`` pixels around its middle, towards every lamp.
    """
    pixels = scene.sensors()[0].film().size()[0]
    count = pixels * pixels * spp
    rng = np.random.default_rng(seed)
    places = np.mgrid[:pixels, :pixels][::-1].reshape(2, 1, -1).repeat(spp, 1) + 0.5
    places = (places + blur * rng.standard_normal(places.shape)).reshape(2, -1) / pixels
    index = dr.arange(mi.UInt32, len(lamps) * count)
    x, y = (dr.gather(mi.Float, mi.Float(row.astype(np.float32)), index % count) for row in places)
    lamp = dr.gather(mi.Point3f, mi.Float(np.float32(lamps).ravel()), index // count)

    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    towards = lamp - si.p
    squared = dr.squared_norm(towards)
    towards = si.to_local(towards * dr.rsqrt(squared))
    value = scene.shapes()[0].bsdf().eval(mi.BSDFContext(), si, towards, si.is_valid())
    value = (value * (DISTANCE**2 / squared)).x
    return dr.mean(mi.TensorXf(value, (len(lamps), spp, pixels, pixels)), axis=1)


def with_z(normals: mi.TensorXf) -> mi.TensorXf:
    """Projected normals as the colours of Mitsuba's ``normalmap``."""
    x, y = normals[:, :, 0], normals[:, :, 1]
    z = dr.sqrt(1 - x * x - y * y)
    return mi.TensorXf(
        dr.ravel(0.5 + 0.5 * mi.Vector3f(x.array, y.array, z.array)), (*normals.shape[:2], 3)
    )


def recovered(
    guess: Photographer,
    photographs: mi.TensorXf,
    show: Callable[[Photographer, mi.TensorXf, float], None],
    spp: int,
    blur: float,
    share: float,
) -> mi.TensorXf:
    """Optimise a map of projected normals, from a flat start, by :data:`COARSE_TO_FINE`.

    ``show(guess, normals, roughness)`` sets the material's parameters; ``spp`` and ``blur`` are
    those of :func:`lit`; ``share`` of the steps.
    """

    # Brightness falls with the square of the distance from the mirror's direction in its exponent.
    # So logarithms lead back from afar. What is darker than the noise does not count.
    floor = 2 * NOISE * dr.mean(photographs, axis=None)

    def logarithm(pictures: mi.TensorXf) -> mi.TensorXf:
        return dr.log(dr.maximum(pictures, 0) + floor)

    aim, seed = logarithm(photographs), 0
    normals = dr.zeros(mi.TensorXf, (COARSE_TO_FINE[0].texels,) * 2 + (2,))
    for stage in COARSE_TO_FINE:
        normals = dr.resample(
            dr.detach(normals), (stage.texels, stage.texels, 2), "linear", boundary="wrap"
        )
        optimizer = mi.ad.Adam(lr=stage.first, params={"normals": normals})
        steps = max(round(share * stage.steps), 2)
        for step in range(steps):
            seed += 1
            optimizer.set_learning_rate(stage.first * (stage.last / stage.first) ** (step / steps))
            # The projection: normals stay inside of the unit disk.
            normals = optimizer["normals"]
            length = dr.sqrt(dr.sum(normals * normals, axis=2) + 1e-12)[:, :, None]
            optimizer["normals"] = normals * dr.minimum(1, 0.9 / length)
            fine = dr.resample(optimizer["normals"], (TEXELS, TEXELS, 2), "linear", boundary="wrap")
            show(guess, fine, stage.roughness)
            guess.params.update()
            pictures = lit(guess.scene, guess.lamps, spp, blur, seed)
            error = dr.mean(dr.square(logarithm(pictures) - aim), axis=None)
            # A normal that no lamp shows has no derivative: a weak prior, that surfaces are flat,
            # leads it back.
            dr.backward(error + PRIOR * dr.mean(dr.square(optimizer["normals"]), axis=None))
            optimizer.step()
        normals = optimizer["normals"]
    return dr.detach(normals)


def angle(normals: np.ndarray, truth: np.ndarray) -> float:
    """Mean angle between projected normals, radians."""
    cosines = (normals * truth).sum(-1) + np.sqrt(
        (1 - (normals**2).sum(-1)) * (1 - (truth**2).sum(-1))
    )
    return float(np.arccos(np.clip(cosines, -1, 1)).mean())


def normal_map(share: float = 1.0, pictures: dict | None = None) -> dict[str, float]:
    """A normal map of 64² texels from 16 photographs, by ``glint_elements``, and by Mitsuba's
    ``normalmap`` around ``roughconductor``, with the same optimiser and the same steps.

    ``glint_elements`` averages over a pixel in closed form: it is asked once per pixel, for the
    whole of it. ``normalmap`` is asked at four places of it.

    ``pictures``, where given, gets the maps, and pictures under a lamp that was not used.
    """
    grid = [-0.18, -0.06, 0.06, 0.18]
    lamps = lamps_around([(x, y) for y in grid for x in grid])
    others = lamps_around([(0, 0), (0.12, 0.0), (-0.12, 0.12), (0.0, -0.12)])
    truth = glintbsdf.maps.isotropic(TEXELS, alpha=0.15, correlation_length=3, seed=3).normals

    def by_elements(normals: np.ndarray) -> mi.Scene:
        material = glints(TEXELS, data=mi.TensorXf(normals), sigma_r=ROUGHNESS, step=1.0)
        return sample(material, TEXELS)

    def by_normalmap(normals: np.ndarray) -> mi.Scene:
        # The film blurs as the footprint of half a pixel and the pixel itself do.
        bitmap = {"type": "bitmap", "data": with_z(mi.TensorXf(normals)), "raw": True}
        metal = {"type": "roughconductor", "alpha": sqrt(2) * ROUGHNESS, "material": "none"}
        material = {"type": "normalmap", "normalmap": bitmap, "nested": metal}
        return sample(material, TEXELS, BLUR)

    def show_elements(guess: Photographer, normals: mi.TensorXf, roughness: float) -> None:
        guess.params[guess.name("plate.bsdf.data")] = normals
        guess.params[guess.name("sigma_r")] = mi.Float(roughness)

    def show_normalmap(guess: Photographer, normals: mi.TensorXf, roughness: float) -> None:
        guess.params[guess.name("normalmap.data")] = with_z(normals)
        guess.params[guess.name("alpha.value")] = mi.Float(sqrt(2) * roughness)

    hidden = glints(TEXELS, data=mi.TensorXf(truth), sigma_r=ROUGHNESS, step=0.5)
    scene = sample(hidden, TEXELS)
    photographs = noisy(Photographer(scene, lamps).pictures(spp=64))
    photographs = mi.TensorXf(np.stack([p.numpy()[..., 0] for p in photographs]))
    new = Photographer(scene, others).pictures(spp=64)

    flat, figures = np.zeros_like(truth), {"angle at the start": angle(np.zeros_like(truth), truth)}
    shown = {"truth": (truth, new[1])}
    for name, make, show, spp, blur in (
        ("glint_elements", by_elements, show_elements, 1, 0.0),
        ("normalmap", by_normalmap, show_normalmap, 4, BLUR),
    ):
        start = time.time()
        guess = Photographer(make(flat), lamps)
        if name == "glint_elements":
            guess.params[guess.name("footprint_sigma")] = mi.Float(BLUR)
        found = recovered(guess, photographs, show, spp, blur, share)
        # Rendered anew, under other lamps.
        rendered = Photographer(make(found.numpy()), others).pictures(spp=64)
        shown[name] = found.numpy(), rendered[1]
        figures |= {
            f"angle, {name}": angle(found.numpy(), truth),
            f"new lamps, {name}": difference(rendered, new),
            f"seconds, {name}": time.time() - start,
        }
    figures["angle, share left"] = figures["angle, glint_elements"] / figures["angle at the start"]
    figures["new lamps, of normalmap's"] = (
        figures["new lamps, glint_elements"] / figures["new lamps, normalmap"]
    )
    if pictures is not None:
        pictures |= shown
    return figures


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    for task in (roughness_and_tint, flakes, normal_map):
        print(task.__name__)
        for name, value in task().items():
            print(f"    {name}: {value:.4g}")
