"""Derivatives with respect to the parameters of a BSDF, against differences.

Two modes of automatic differentiation agree on a graph that is wrong. And what counts is the image:
:func:`render_derivatives` renders a plate under a lamp, by any integrator, and compares what
``mi.render`` returns with central differences of the same random numbers.
:func:`check_value_derivatives` does so with values of a BSDF, for settings that have no image here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf import maps
from glintbsdf.check.suite import View, intensity, sample
from glintbsdf.core.alignment import aligned

#: Relative step of central differences.
STEP = 0.02

#: Relative error allowed in images, where three standard errors are less; and in values of a BSDF
#: (measured: 0.0046), where places are many and the same.
ERROR, VALUE_ERROR = 0.02, 0.01


@dataclass(frozen=True)
class Derivative:
    """A derivative of an image, and what differences say of it.

    Attributes:
        key (str): the parameter, as ``mi.traverse`` names it in the BSDF.
        mode (str): ``reverse`` or ``forward``.
        automatic, difference (float): both derivatives, per relative change of the parameter.
        noise (float): three standard errors of the mean difference between both.
        compiled (int): kernels that Dr.Jit compiled after the first seed.
    """

    key: str
    mode: str
    automatic: float
    difference: float
    noise: float
    compiled: int

    @property
    def right(self) -> bool:
        """Whether both agree within 2 %, or within their noise."""
        allowed = max(self.noise, ERROR * abs(self.difference))
        return abs(self.automatic - self.difference) <= allowed

    def row(self) -> dict:
        """The derivative as a row of a table."""
        return {**asdict(self), "right": str(self.right)}

    def __str__(self) -> str:
        return (
            f"{self.key}, {self.mode}: {self.automatic:.4g}, central differences "
            f"{self.difference:.4g}, noise {self.noise:.2g}, {self.compiled} kernels compiled anew"
        )


#: Integrators whose derivatives are right, and the arguments of :func:`render_derivatives` that it
#: takes to see them: ``prb_basic`` finds lights by samples of the BSDF only, and short steps drown
#: in its noise.
INTEGRATORS: dict[str, dict] = {
    "prb": {},
    "prb_basic": {"lamp": "sphere", "spp": 256, "seeds": 8, "step": STEP},
    "direct": {},
    "path": {},
    "glint_path": {},
}


def examples() -> dict[str, tuple[dict, tuple[str, ...], dict]]:
    """Every plugin with all of its parameters that have a derivative image by image.

    By name: a description inside of an adapter for its back; the parameters; and further arguments
    of :func:`render_derivatives` that it takes to see their derivatives. The densities of flakes
    and of microdetails are not among them: their derivatives are right on average over patterns
    alone. Under a point light, differences of the exact P-NDF of a map jump as its triangles move.
    """
    normals = maps.isotropic(32, alpha=0.2, correlation_length=3, seed=5).normals
    data = {"data": mi.TensorXf(normals)}
    tint = {"specular_reflectance": 0.7}
    metal = {"eta": 0.2, "k": 3.9, **tint}
    reflectance = "specular_reflectance.value"
    of_metal = ("eta.value", "k.value", reflectance)
    sizes = ("footprint_sigma", "pixel_spread")
    elements = {"type": "glint_elements", "sigma_r": 0.05, **data}
    manifold = {"type": "glint_manifold", "footprint_sigma": 2.0, **data}
    tables = {**manifold, "footprint_sigma": 9.0, "max_error": 0.05}
    lean = {"type": "glint_filtered", "alpha": 0.1, **metal, **data}
    diffuse = {"type": "glint_diffuse", "footprint_sigma": 2.0, **data}
    mip = {
        "type": "glint_mip", "output_size": 128, "patch_size": 16, "sigma_r": 0.05, **data
    }  # fmt: skip
    flakes = {"type": "glint_elements", "flake_density": 400.0, "sigma_r": 0.08}
    rough = {"alpha": 0.2, **tint}
    grid = {"type": "glint_grid", "density": 6.0, "int_ior": 1.5, **rough}
    particles = {"type": "glint_particles", "micro_alpha": 0.05, "density": 4.0, **rough}
    lamp = {"lamp": "sphere", "spp": 64}
    table: dict[str, tuple[dict, tuple[str, ...], dict]] = {
        "elements": (elements, ("sigma_r", *sizes, "data"), {}),
        "elements, lamp": (elements, ("sigma_r", "data"), lamp),
        "manifold": ({**manifold, **metal}, (*sizes, *of_metal), {}),
        "manifold, map": (manifold, ("data",), {**lamp, "spp": 128}),
        "tables": (tables, ("footprint_sigma",), {}),
        # Its image is smooth, but more curved in the footprint than differences of STEP can tell.
        "lean": (lean, ("alpha", *sizes, "data", *of_metal), {"step": 0.25 * STEP}),
        "diffuse": (diffuse, ("data", "footprint_sigma", "reflectance.value"), {}),
        "mip": (mip, ("sigma_r", "footprint_sigma"), {}),
        "flakes": (flakes, ("sigma_r", "flake_alpha"), {}),
        "particles": (particles, ("alpha_u", "alpha_v", "micro_alpha", reflectance), {}),
        "grid": (
            grid,
            ("alpha_u", "alpha_v", "intensity", "eta", reflectance),
            {"patterns": True, "seeds": 16},
        ),
    }
    return {
        name: ({"type": "twosided", "nested": {"pixel_spread": 0.02, **bsdf}}, keys, settings)
        for name, (bsdf, keys, settings) in table.items()
    }


#: Lights over the plate. Only under the first do samples keep their places as parameters change, so
#: that differences of few samples tell the derivative. A BSDF's own samples find the second only.
LAMPS = {
    "point": {"type": "point", "position": [0.6, 0.3, 4], "intensity": 8.0},
    "sphere": {
        "type": "sphere",
        "center": [0.6, 0.3, 4],
        "radius": 0.5,
        "emitter": {"type": "area", "radiance": 10.0},
    },
}


def plate(bsdf: dict, integrator: str = "prb", lamp: str = "point", size: int = 16) -> dict:
    """A plate under one of the :data:`LAMPS`, for ``mi.load_dict``; the picture has ``size``²
    pixels."""
    depth = {} if integrator == "direct" else {"max_depth": 2}
    return {
        "type": "scene",
        "integrator": {"type": integrator, **depth},
        "sensor": {
            "type": "perspective",
            "fov": 30,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "plate": {"type": "rectangle", "bsdf": bsdf},
        "lamp": LAMPS[lamp],
    }


class Grown:
    """Parameters, all values of each times a factor.

    Attributes:
        names (dict): what ``params`` calls each key.
    """

    def __init__(self, params: mi.SceneParameters, names: dict[str, str]) -> None:
        self.params, self.names = params, names
        self.start = {key: np.array(self.params[name]) for key, name in names.items()}
        self.now: dict[str, tuple] = {}

    @staticmethod
    def of_plate(scene: mi.Scene, keys: Sequence[str]) -> Grown:
        """Parameters of the BSDF of a :func:`plate`."""
        params = mi.traverse(scene)
        known, names = list(params.keys()), {}
        for key in keys:
            found = [n for n in known if n.startswith("plate.") and n.endswith("." + key)]
            if len(found) != 1:
                raise ValueError(f'"{key}" must be a parameter of the BSDF (got {known})')
            names[key] = found[0]
        return Grown(params, names)

    def values(self, key: str, factor: float) -> object:
        """The values of a parameter, in its own type."""
        kind = type(self.params[self.names[key]])
        values = aligned((self.start[key] * factor).astype(np.float32))
        return kind(values) if dr.is_tensor_v(kind) else kind(values.ravel())

    def set(self, factor: float, differentiable: bool, **others: float) -> None:
        """Set all parameters; ``others``: the factors of some of them, by key."""
        for key, name in self.names.items():
            wanted = others.get(key, factor), differentiable
            if self.now.get(key) == wanted and not differentiable:
                continue  # or the structures that depend on it would be made anew
            self.now[key] = wanted
            self.params[name] = self.values(key, wanted[0])
            if differentiable:
                dr.enable_grad(self.params[name])
        self.params.update()

    def gradients(self) -> dict[str, float]:
        """The derivatives that the parameters have received, per relative change."""
        return {
            key: float((np.array(dr.grad(self.params[name])).reshape(start.shape) * start).sum())
            for (key, name), start in zip(self.names.items(), self.start.values(), strict=True)
        }


class Picture:
    """A picture of a plate, summed to one number.

    It is weighed by itself, so that contrast counts as well as brightness.

    Args:
        description: of the scene, see :func:`plate`.
        keys: the parameters to differentiate by, as ``mi.traverse`` names them in the BSDF.
        spp: samples per pixel.
    """

    def __init__(self, description: dict, keys: Sequence[str], spp: int) -> None:
        self.scene = mi.load_dict(description)
        self.grown, self.spp = Grown.of_plate(self.scene, keys), spp
        self.grown.set(1, False)
        weights = mi.render(self.scene, spp=4 * spp, seed=0)
        self.weights = dr.detach(weights / dr.mean(weights, axis=None))

    def sum(self, seed: int, params: mi.SceneParameters | None = None) -> mi.Float:
        """The number; differentiable by ``params`` if they are given."""
        # Derivatives take the samples of the differences; the image beside them is not looked at.
        seeds = {"seed": seed} if params is None else {"seed": 0, "seed_grad": seed}
        image = mi.render(self.scene, params, spp=self.spp, **seeds)
        return dr.mean(image * self.weights, axis=None)

    def difference(self, key: str, seed: int, step: float = STEP) -> float:
        """Central difference for a relative change of a parameter, by ``step`` to both sides."""
        values = []
        for factor in (1 + step, 1 - step):
            self.grown.set(1, False, **{key: factor})
            values.append(float(self.sum(seed).array[0]))
        return (values[0] - values[1]) / (2 * step)

    def reverse(self, seed: int) -> list[float]:
        """The derivatives with respect to all parameters, per relative change."""
        self.grown.set(1 + 1e-4 * seed, True)  # other values, as steps of an optimisation have
        dr.backward(self.sum(seed, self.grown.params))
        return list(self.grown.gradients().values())

    def forward(self, seed: int) -> list[float]:
        """The sum of :meth:`reverse`, in forward mode."""
        self.grown.set(1 + 1e-4 * seed, True)
        params = self.grown.params
        # What an update derives from a parameter lies outside of the rendering: it takes its
        # derivative first, as Mitsuba asks it of everybody who goes forward.
        for key, name in self.grown.names.items():
            dr.set_grad(params[name], self.grown.values(key, 1))
            dr.enqueue(dr.ADMode.Forward, params[name])
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        return [float(dr.forward_to(self.sum(seed, params)).array[0])]


def render_derivatives(
    bsdf: dict,
    keys: Sequence[str],
    integrator: str = "prb",
    spp: int = 16,
    seeds: int = 3,
    modes: Sequence[str] = ("reverse",),
    lamp: str = "point",
    patterns: bool = False,
    step: float = STEP,
) -> list[Derivative]:
    """Derivatives of a :class:`Picture` with respect to parameters, and differences of pictures.

    All values of a parameter grow by the same factor. In reverse mode all parameters are
    differentiated at once. In forward mode they are asked for together: the result is their sum,
    under the keys' names.

    Args:
        bsdf: description of the BSDF, with an adapter for its back.
        keys: the parameters, as ``mi.traverse`` names them in the BSDF.
        integrator: its plugin.
        spp: samples per pixel of 16².
        seeds: how many seeds, which tell the noise.
        modes: ``reverse``, ``forward`` or both.
        lamp: which of the :data:`LAMPS` is over the plate.
        patterns: whether the ``seed`` of the BSDF changes as well: its derivatives are right on
            average over random patterns only.
        step: of the differences, relative.
    """

    def picture(seed: int) -> Picture:
        nested = {**bsdf["nested"], "seed": seed} if patterns else bsdf["nested"]
        return Picture(plate({**bsdf, "nested": nested}, integrator, lamp), keys, spp)

    fixed = None if patterns else picture(0)
    differences: list[list[float]] = []
    automatic: dict[str, list[list[float]]] = {mode: [] for mode in modes}
    compiled = 0
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(1, seeds + 1):
            dr.kernel_history_clear()
            one = fixed or picture(seed)
            differences.append([one.difference(key, seed, step) for key in keys])
            for mode, results in automatic.items():
                results.append(one.reverse(seed) if mode == "reverse" else one.forward(seed))
            if seed > 1:
                history = dr.kernel_history([dr.KernelType.JIT])
                compiled += sum(not kernel["cache_hit"] for kernel in history)
            del one  # before the next: while two scenes live, Mitsuba numbers their parts otherwise

    def compared(key: str, mode: str, ours: np.ndarray, theirs: np.ndarray) -> Derivative:
        noise = 3 * (ours - theirs).std(ddof=1) / np.sqrt(seeds)
        return Derivative(
            key, mode, float(ours.mean()), float(theirs.mean()), float(noise), compiled
        )

    theirs, result = np.array(differences), []
    if "reverse" in modes:
        ours = np.array(automatic["reverse"])
        result += [compared(key, "reverse", ours[:, i], theirs[:, i]) for i, key in enumerate(keys)]
    if "forward" in modes:
        ours = np.array(automatic["forward"])[:, 0]
        result.append(compared(" + ".join(keys), "forward", ours, theirs.sum(axis=1)))
    return result


def check_render_derivatives(
    bsdf: dict, keys: Sequence[str], integrator: str = "prb", resolution: float = 0.1, **settings
) -> None:
    """Derivatives of an image are right, and their steps compile no kernel anew.

    See :func:`render_derivatives`, which takes the ``settings``. A check so noisy that it would let
    ``resolution`` times the derivative pass fails as well.
    """
    for derivative in render_derivatives(bsdf, keys, integrator, **settings):
        assert derivative.right, f"{integrator}: {derivative}"
        clear = derivative.noise <= resolution * abs(derivative.difference)
        assert clear, f"{integrator}, too noisy: {derivative}"
        assert derivative.compiled == 0, f"{integrator}: {derivative}"


def check_value_derivatives(bsdf: mi.BSDF, view: View, *keys: str, count: int = 5000) -> None:
    """Derivatives of the mean of ``count`` values of a BSDF are those of central differences.

    The places lie all over the map, and the directions are samples of the BSDF there. Values jump
    where the edge of a footprint crosses a texel, so that derivatives are right on average.
    """
    si, bs, _ = sample(bsdf, view, count, seed=7, everywhere=True)
    grown = Grown(mi.traverse(bsdf), {key: key for key in keys})

    def mean() -> mi.Float:
        return dr.mean(intensity(bsdf.eval(mi.BSDFContext(), si, bs.wo)), axis=None)

    def value(key: str, factor: float) -> float:
        grown.set(1, False, **{key: factor})
        return float(mean()[0])

    grown.set(1, True)
    dr.backward(mean())
    for key, found in grown.gradients().items():
        expected = (value(key, 1 + STEP) - value(key, 1 - STEP)) / (2 * STEP)
        told = f"{key}: {found:.4g}, central differences {expected:.4g}"
        assert abs(found - expected) <= VALUE_ERROR * abs(expected), told
