"""The parameters of a plugin, read from ``mi.Properties`` and checked.

How values arrive in Mitsuba 3.9: ``<float>`` and Python floats as ``float``, ``<integer>`` and
Python integers as ``int``, ``<transform>`` and every Python transform as a 4×4
``ScalarAffineTransform4d``, ``<rgb>`` as a colour, ``<spectrum>`` as pairs of wavelength and value,
nested textures and ``mi.Bitmap`` as objects, tensors and other Dr.Jit arrays as "any". NumPy
arrays are refused by Mitsuba itself.

Properties that nobody reads are reported by Mitsuba as errors, so a parameter is read only where it
has a meaning.
"""

from __future__ import annotations

from math import inf, isfinite
from pathlib import Path

import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import ParameterError, check, check_choice
from glintbsdf.maps.normalmap import MAP_TYPES, WRAP_MODES, NormalMap
from glintbsdf.microfacet.frame import Conductor, Dielectric

MAP_SOURCES = ("filename", "bitmap", "data")


class Parameters:
    """Reads the properties of one plugin; every method raises ``ParameterError`` for bad values."""

    def __init__(self, props: mi.Properties) -> None:
        self.props = props
        self.owner = props.plugin_name()

    # ----------------------------------------------------------------------------------------------
    #  Simple values
    # ----------------------------------------------------------------------------------------------

    def number(self, name: str, default: float, minimum: float = 0.0) -> float:
        """A finite number of at least ``minimum``, which may be ``-inf``."""
        value = self.props.get(name, default)
        requirement = "a finite number" + (f" ≥ {minimum:g}" if isfinite(minimum) else "")
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        check(
            is_number and isfinite(value) and value >= minimum, self.owner, name, requirement, value
        )
        return float(value)

    def per_axis(self, name: str, default: float) -> tuple[float, float]:
        """``name_u`` and ``name_v``, or ``name`` for both: finite numbers ≥ 0."""
        axes = (f"{name}_u", f"{name}_v")
        self.only_one_of((name,), axes)
        if name in self.props:
            default = self.number(name, default)
        return tuple(self.number(axis, default) for axis in axes)

    def choice(self, name: str, default: str, choices: tuple[str, ...]) -> str:
        """One of the strings ``choices``."""
        value = self.props.get(name, default)
        check_choice(self.owner, name, value, choices)
        return value

    def boolean(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self.props.get(name, default)
        check(isinstance(value, bool), self.owner, name, "true or false", value)
        return value

    def only_one_of(self, *groups: tuple[str, ...]) -> None:
        """Refuse properties of more than one of the ``groups``, which contradict each other."""
        given = [[name for name in group if name in self.props] for group in groups]
        given = [group for group in given if group]
        if len(given) > 1:
            choices = " and ".join(f'"{group[0]}"' for group in given)
            got = ", ".join(name for group in given for name in group)
            raise ParameterError(f"{self.owner}: {choices} exclude each other (got {got})")

    # ----------------------------------------------------------------------------------------------
    #  The normal map
    # ----------------------------------------------------------------------------------------------

    def normal_map(self, instead: str = "") -> NormalMap:
        """The map from ``filename``, ``bitmap`` or ``data``; a relative file name is resolved with
        ``mi.file_resolver()``, against the scene's folder.

        ``instead``: a parameter that may be given in place of a map, for the message of the error.
        """
        self.only_one_of(*((source,) for source in MAP_SOURCES))
        sources = [source for source in MAP_SOURCES if source in self.props]
        if not sources:
            requirement = 'one of "filename", "bitmap" or "data" must give the normal or height map'
            if instead:
                requirement += f', or "{instead}" take its place'
            raise ParameterError(f"{self.owner}: {requirement} (got none of them)")
        source = sources[0]
        value = self.props[source]
        options = {
            "map_type": self.choice("map_type", "auto", MAP_TYPES),
            "height_scale": self.number("height_scale", 1.0, minimum=-inf),
            "wrap_mode": self.choice("wrap_mode", "repeat", WRAP_MODES),
            "owner": self.owner,
        }
        if source == "filename":
            check(isinstance(value, str), self.owner, source, "a string", value)
            return NormalMap.load(Path(str(mi.file_resolver().resolve(value))), **options)
        if source == "bitmap":
            check(isinstance(value, mi.Bitmap), self.owner, source, "an mi.Bitmap", value)
            return NormalMap.from_bitmap(value, **options)
        check(
            self.props.type(source) == mi.Properties.Type.Any and hasattr(value, "shape"),
            self.owner,
            source,
            "a tensor such as mi.TensorXf, of H×W×C values",
            value,
        )
        return NormalMap.from_array(value, **options)

    def to_uv(self) -> mi.ScalarAffineTransform3f:
        """The transform of UV space, whose linear part must be finite and invertible."""
        value = self.props.get("to_uv", mi.ScalarAffineTransform4f())
        check(
            self.props.type("to_uv") == mi.Properties.Type.Transform
            if "to_uv" in self.props
            else True,
            self.owner,
            "to_uv",
            "a transform",
            value,
        )
        to_uv = mi.ScalarAffineTransform3f(value.extract().matrix)
        matrix = to_uv.matrix
        determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        entries = [matrix[row, column] for row in range(2) for column in range(3)]
        check(
            all(map(isfinite, entries)) and determinant != 0,
            self.owner,
            "to_uv",
            "a finite, invertible transform of the UV plane",
            entries,
        )
        return to_uv

    # ----------------------------------------------------------------------------------------------
    #  Colours
    # ----------------------------------------------------------------------------------------------

    def colors(self, name: str, choices: tuple[str, ...]) -> str | np.ndarray:
        """One of the strings ``choices``, or the colours of an image: linear RGB, N×3, float32.

        The image comes from a file, whose relative name is resolved as that of a map, or from an
        ``mi.Bitmap``. Integer pixels are sRGB unless the bitmap says otherwise, as everywhere in
        Mitsuba. Colours must be finite and not negative.
        """
        value = self.props.get(name, choices[0])
        if isinstance(value, str) and value in choices:
            return value
        requirement = f"one of {', '.join(choices)}, the name of an image file or an mi.Bitmap"
        bitmap = value
        if isinstance(value, str):
            path = Path(str(mi.file_resolver().resolve(value)))
            check(path.is_file(), self.owner, name, requirement, value)
            try:
                bitmap = mi.Bitmap(str(path))
            except RuntimeError as error:
                raise ParameterError(
                    f'{self.owner}: "{name}" must be a readable image file (got "{value}": {error})'
                ) from error
        check(isinstance(bitmap, mi.Bitmap), self.owner, name, requirement, value)
        pixels = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
        pixels = pixels.reshape(-1, 3)
        bad = ~(np.isfinite(pixels) & (pixels >= 0)).all(axis=1)
        check(
            len(pixels) > 0 and not bad.any(),
            self.owner,
            name,
            "an image of finite colours ≥ 0",
            f"{bad.sum()} other pixels of {len(pixels)}",
        )
        return pixels

    # ----------------------------------------------------------------------------------------------
    #  The material
    # ----------------------------------------------------------------------------------------------

    def fresnel(self) -> Conductor | Dielectric | None:
        """Reflectance from ``material``, or ``eta`` and ``k``, or ``int_ior`` and ``ext_ior``.

        None for a perfect mirror, the default, which needs no code. In polarised variants a mirror
        is the conductor of ``roughconductor``'s default (eta = 0, k = 1), which reflects everything
        and has a Mueller matrix.
        """
        self.only_one_of(("material",), ("eta", "k"), ("int_ior", "ext_ior"))
        props = self.props
        if "int_ior" in props or "ext_ior" in props:
            return Dielectric(self.ior("int_ior", "bk7") / self.ior("ext_ior", "air"))
        if "eta" in props or "k" in props:
            return Conductor(self.spectrum("eta", 0.0), self.spectrum("k", 1.0))
        material = props.get("material", "none")
        if material != "none":
            return Conductor(*self.conductor_preset(material))
        if mi.is_polarized:
            return Conductor(uniform_texture(0.0), uniform_texture(1.0))
        return None

    def specular_reflectance(self) -> mi.Texture | None:
        """The tint, in [0, 1], or None where none is given, which needs no code."""
        if "specular_reflectance" not in self.props:
            return None
        return self.spectrum("specular_reflectance", 1.0, maximum=1.0)

    def spectrum(self, name: str, default: float, maximum: float = inf) -> mi.Texture:
        """A number, colour, spectrum or texture with values from 0 to ``maximum``, as a texture.

        Only what is given as numbers is checked here: a texture has checked itself.
        """
        value = self.props.get(name, default)
        numeric = {
            mi.Properties.Type.Integer: lambda: [value],
            mi.Properties.Type.Float: lambda: [value],
            mi.Properties.Type.Color: lambda: list(value),
            mi.Properties.Type.Spectrum: lambda: list(value.values),
        }
        kind = self.props.type(name) if name in self.props else mi.Properties.Type.Float
        is_texture = isinstance(value, mi.Texture)
        requirement = "a number, colour, spectrum or texture of finite values ≥ 0" + (
            f" and ≤ {maximum:g}" if isfinite(maximum) else ""
        )
        check(
            is_texture
            or (
                kind in numeric and all(isfinite(x) and 0 <= x <= maximum for x in numeric[kind]())
            ),
            self.owner,
            name,
            requirement,
            value,
        )
        # Mitsuba bounds the colours of get_texture by 1: fit for a reflectance, not for an index.
        if isfinite(maximum):
            return self.props.get_texture(name, default)
        return self.props.get_unbounded_texture(name, default)

    def ior(self, name: str, default: str) -> float:
        """An index of refraction: a number > 0 or the name of one of Mitsuba's presets."""
        value = self.props.get(name, default)
        if isinstance(value, str):
            named = mi.Properties()
            named[name] = value
            try:
                return mi.lookup_ior(named, name, default)
            except RuntimeError as error:
                choices = str(error).partition("Valid choices are:")[2].strip()
                raise ParameterError(
                    f'{self.owner}: "{name}" must be a number > 0 or one of '
                    f'{choices} (got "{value}")'
                ) from None
        number = self.number(name, 0.0)
        check(number > 0, self.owner, name, "a number > 0 or the name of a material", value)
        return number

    def conductor_preset(self, material: str) -> tuple[mi.Texture, mi.Texture]:
        """The textures eta and k of one of Mitsuba's metals, from its ``conductor`` plugin."""
        check(isinstance(material, str), self.owner, "material", "a string", material)

        class Collect(mi.TraversalCallback):
            def put(self, name: str, value: object, flags: int) -> None:
                found[name] = value

        found: dict[str, object] = {}
        try:
            mi.load_dict({"type": "conductor", "material": material}).traverse(Collect())
        except RuntimeError:
            presets = sorted(
                path.name.removesuffix(".eta.spd")
                for path in Path(mi.__file__).parent.glob("data/ior/*.eta.spd")
            )
            check_choice(self.owner, "material", material, ("none", *presets))
            raise
        return found["eta"], found["k"]


def uniform_texture(value: float) -> mi.Texture:
    """A texture of one value everywhere and at every wavelength."""
    return mi.load_dict({"type": "uniform", "value": value})
