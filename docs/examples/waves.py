"""Waves: a P-NDF of one's own, and the plugin around it.

The surface ripples along u and v. Its projected normal at the place u of the UV plane is

    s(u) = a (sin 2πf u, sin 2πf v),        J = ∂s/∂u = 2πf a diag(cos 2πf u, cos 2πf v).

Where the footprint N(u₀, Σ) is short against the waves, s is linear under it, and the normals are a
Gaussian of mean s(u₀) and covariance σ_r² I + J Σ Jᵀ.
"""

from math import pi

import drjit as dr
import mitsuba as mi

from glintbsdf.bridge.bsdf import GlintBSDF
from glintbsdf.bridge.parameters import Parameters
from glintbsdf.bridge.registration import register_plugin
from glintbsdf.core.errors import check
from glintbsdf.pndf.base import PNDF, register
from glintbsdf.pndf.gaussian_elements import Gaussian
from glintbsdf.pndf.smooth import SmoothBeckmann, smooth_alpha


@register("waves", title="waves", plugin="glint_waves", takes_map=False)
class Waves(PNDF):
    """The normals of a rippled surface; ``frequency`` in waves per unit of UV."""

    roughness_keys = ("amplitude", "sigma_r")

    def __init__(self, amplitude=0.1, frequency=10.0, sigma_r=0.02, owner="Waves"):
        check(0 <= amplitude < 0.5, owner, "amplitude", "a number in [0, 0.5)", amplitude)
        check(0 < sigma_r < 0.2, owner, "sigma_r", "a number in (0, 0.2)", sigma_r)
        self.amplitude, self.sigma_r = mi.Float(amplitude), mi.Float(sigma_r)
        self.frequency, self.owner = mi.Float(frequency), owner

    def lobe(self, query):
        """Mean and distribution of the normals under the footprint; made once for each query."""

        def make():
            wave, footprint = 2 * pi * self.frequency, query.footprint
            slope_u, slope_v = wave * self.amplitude * dr.cos(wave * footprint.uv)
            jacobian = mi.Matrix2f(slope_u, 0, 0, slope_v)
            if query.turn is not None:  # the half vector turns over the footprint
                jacobian = jacobian - query.turn
            axes = (jacobian @ footprint.du, jacobian @ footprint.dv, *query.spread)
            mean = self.amplitude * dr.sin(wave * footprint.uv)
            return mi.Vector2f(mean), Gaussian(axes, dr.square(self.sigma_r))

        return query.once((self, "lobe"), make)

    def _eval(self, m, query, active):
        mean, normals = self.lobe(query)
        return dr.select(active & (dr.squared_norm(m) < 1), normals.eval(m - mean), 0)

    def _sample(self, query, sample1, sample2, active):
        mean, normals = self.lobe(query)
        return mean + normals.sample(mi.Vector2f(mi.warp.square_to_std_normal(sample2)))

    def alpha_squared(self):
        return mi.Vector2f(dr.square(self.amplitude))  # twice the variance of a sine

    def smooth(self):
        alpha = lambda: smooth_alpha(self.alpha_squared(), self.sigma_r)  # noqa: E731
        return SmoothBeckmann(alpha, self.roughness_keys, self.owner)

    def traverse(self, callback):
        for name in ("amplitude", "sigma_r"):
            callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)


class GlintWaves(GlintBSDF):
    """The plugin ``glint_waves``."""

    def __init__(self, props):
        super().__init__(props)
        parameters = Parameters(props)
        defaults = {"amplitude": 0.1, "frequency": 10.0, "sigma_r": 0.02}
        self.options = {name: parameters.number(name, x) for name, x in defaults.items()}
        self.masking_name = parameters.choice("masking", "beckmann", Waves.maskings)
        self.finish()

    def create(self, domain):
        return Waves(**self.options, owner=self.owner)


register_plugin("glint_waves", GlintWaves)
