"""The parameters of a plugin, read from ``mi.Properties`` and checked.

How values arrive in Mitsuba 3.9: ``<float>`` and Python floats as ``float``, ``<integer>`` and
Python integers as ``int``, ``<transform>`` and every Python transform as a 4×4
``ScalarAffineTransform4d``, ``<rgb>`` as a colour, ``<spectrum>`` as pairs of wavelength and value,
nested textures and ``mi.Bitmap`` as objects, tensors and other Dr.Jit arrays as "any". NumPy
arrays are refused by Mitsuba itself.

Mitsuba reports properties that nobody reads as errors, so a parameter is read only where it has a
meaning. An unknown name is refused here; the error suggests the parameter that it resembles.

The type and range of every parameter are declared in :data:`PARAMETERS`, and nowhere else. At the
ends of a range, single precision is still enough for everything that is computed. Conditions that
depend on other parameters or on the map are checked where these are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from math import pi
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import ParameterError, check, check_choice, describe
from glintbsdf.maps.normalmap import ENCODINGS, MAP_TYPES, WRAP_MODES, NormalMap
from glintbsdf.maps.reading import is_file
from glintbsdf.microfacet.interface import Conductor, Dielectric, Interface, Mirror

MAP_SOURCES = ("filename", "bitmap", "data")


#: The largest entry of a transform. Far beyond it, squares of footprints and their products leave
#: the range of float32.
LARGEST_ENTRY = 1e7


class Number(NamedTuple):
    """A number from ``minimum`` to ``maximum``.

    Attributes:
        above, below (bool): whether the number must differ from ``minimum``, from ``maximum``.
        whole (bool): whether it must be a whole number.
    """

    minimum: float = 0.0
    maximum: float = 1e6
    above: bool = False
    below: bool = False
    whole: bool = False

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a finite number"
        if self.above or self.below:
            low, high = "(" if self.above else "[", ")" if self.below else "]"
            return f"{kind} in {low}{self.minimum:.10g}, {self.maximum:.10g}{high}"
        return f"{kind} from {self.minimum:.10g} to {self.maximum:.10g}"

    def holds(self, value: object) -> bool:
        """Whether ``value`` is a number in the range; a boolean is not a number."""
        types = (int,) if self.whole else (int, float)
        if not isinstance(value, types) or isinstance(value, bool):
            return False
        over = value > self.minimum if self.above else value >= self.minimum
        return over and (value < self.maximum if self.below else value <= self.maximum)


class Kind(NamedTuple):
    """The type of a parameter that is not a number, in words."""

    name: str

    def __str__(self) -> str:
        return self.name


NAME = Kind("a name")
FLAG = Kind("true or false")
TEXT = Kind("a string")
BITMAP = Kind("an mi.Bitmap")
TENSOR = Kind("a tensor")
TRANSFORM = Kind("a transform")
SPECTRUM = Kind("a number, colour, spectrum or texture")
INDEX = Kind("a number or the name of a material")
SHARE = Kind("auto or a number from 0 to 1")
COLORS = Kind("a name, an image file or an mi.Bitmap")

#: Indices of refraction, and their imaginary part. Fresnel's equations have their fourth power.
INDICES = Number(1e-3, 1e3)
EXTINCTION = Number(0.0, 1e3)

#: Any finite number.
ANY = Number()

_SEED = Number(0, 2**32 - 1, whole=True)
_MATERIAL: Mapping[str, Number | Kind] = {
    "material": NAME,
    "eta": SPECTRUM,
    "k": SPECTRUM,
    "int_ior": INDEX,
    "ext_ior": INDEX,
    "specular_reflectance": SPECTRUM,
}
_FOOTPRINT: Mapping[str, Number | Kind] = {
    "to_uv": TRANSFORM,
    "footprint_sigma": Number(0, 100),
    "pixel_spread": Number(0, pi),
}
_MAP: Mapping[str, Number | Kind] = {
    "filename": TEXT,
    "bitmap": BITMAP,
    "data": TENSOR,
    "layer": TEXT,
    "map_type": NAME,
    "height_scale": Number(-1e9, 1e9),
    "wrap_mode": NAME,
    "encoding": NAME,
    "flip_y": FLAG,
    "strength": Number(0, 1000),
    "fill_voids": FLAG,
}
_ROUGHNESS = Number(1e-4, 10)

#: The parameters of every plugin, by its type.
PARAMETERS: Mapping[str, Mapping[str, Number | Kind]] = {
    "glint_manifold": {
        **_MAP,
        **_FOOTPRINT,
        **_MATERIAL,
        "kernel": NAME,
        "epsilon": Number(1e-12, 1, below=True),
        "threshold": Number(0, 1e3),
        "max_error": Number(0, 10),
        "hand_over": Number(0, 1e6),
        "masking": NAME,
        "height_correlated": FLAG,
    },
    "glint_elements": {
        **_MAP,
        **_FOOTPRINT,
        **_MATERIAL,
        "sigma_r": Number(1e-8, 1),
        "step": Number(1 / 16, 1e3),
        "elements": NAME,
        "flake_density": Number(1, 1e9),
        "flake_alpha": Number(0, 10),
        "seed": _SEED,
        "masking": NAME,
    },
    "glint_mip": {
        **_MAP,
        **_FOOTPRINT,
        **_MATERIAL,
        "sigma_r": Number(1e-8, 1),
        "output_size": Number(4, 1 << 16, whole=True),
        "patch_size": Number(3, 1 << 15, whole=True),
        "overlap": Number(1, 1 << 14, whole=True),
        "representation": NAME,
        "max_error": Number(0, 10),
        "clusters": Number(1, 1024, whole=True),
        "lod_scale": Number(0, 16, below=True),
        "balance": Number(0, 1),
        "normal_weight": Number(0, 1e6),
        "seed": _SEED,
        "masking": NAME,
    },
    "glint_filtered": {
        **_MAP,
        **_FOOTPRINT,
        **_MATERIAL,
        "method": NAME,
        "alpha": _ROUGHNESS,
        "distribution": NAME,
        "max_anisotropy": Number(1, 1024),
        "masking": NAME,
        "height_correlated": FLAG,
    },
    "glint_diffuse": {**_MAP, **_FOOTPRINT, "reflectance": SPECTRUM, "method": NAME},
    "glint_grid": {
        **_FOOTPRINT,
        **_MATERIAL,
        **{f"alpha{axis}": _ROUGHNESS for axis in ("", "_u", "_v")},
        **{f"detail_alpha{axis}": Number(0, 10, above=True) for axis in ("", "_u", "_v")},
        "density": Number(-20, 20),
        "size_variation": Number(0, 100),
        "intensity": Number(0, 1e6),
        "light_spread": Number(0, pi / 2, below=True),
        "colors": COLORS,
        "max_anisotropy": Number(1, 1024),
        "seed": _SEED,
    },
    "glint_particles": {
        **_FOOTPRINT,
        **_MATERIAL,
        "distribution": NAME,
        **{f"alpha{axis}": _ROUGHNESS for axis in ("", "_u", "_v")},
        "micro_alpha": Number(1e-6, 10),
        "density": Number(-8, 16),
        "colors": COLORS,
        "color": SPECTRUM,
        "hue_variation": Number(0, 0.5),
        "saturation_variation": Number(0, 1),
        "value_variation": Number(0, 1),
        "space": NAME,
        "to_object": TRANSFORM,
        "masking": NAME,
        "height_correlated": FLAG,
        "seed": _SEED,
    },
    "glint_path": {
        "max_depth": Number(-1, 2**31 - 1, whole=True),
        "rr_depth": Number(1, 2**31 - 1, whole=True),
        "hide_emitters": FLAG,
        "timeout": Number(-1, 1e9),
        "block_size": Number(1, 1 << 16, whole=True),
        "samples_per_pass": Number(1, 2**32 - 1, whole=True),
        "separate": FLAG,
        "pixel_share": SHARE,
        "light_share": SHARE,
        "emitters": NAME,
    },
}


#: Names that other renderers have for our parameters, without underscores; those that fit best come
#: first. The page "Names in other renderers" explains them.
OTHER_NAMES: Mapping[str, tuple[str, ...]] = {
    "roughness": ("alpha", "sigma_r"),
    "flakeroughness": ("sigma_r", "detail_alpha"),
    "flakeglossiness": ("sigma_r", "detail_alpha"),
    "glitterroughness": ("sigma_r", "detail_alpha"),
    "glossiness": ("alpha", "sigma_r"),
    "flakeorientation": ("flake_alpha", "alpha"),
    "normalrandomize": ("flake_alpha", "alpha"),
    "flakenormalrandomize": ("flake_alpha", "alpha"),
    "flakeamount": ("flake_density", "density"),
    "flakesize": ("flake_density", "density"),
    "glitterdensity": ("density", "flake_density"),
    "glittersize": ("density", "flake_density"),
    "flakeseed": ("seed",),
    "randomseed": ("seed",),
    "basecolor": ("specular_reflectance", "reflectance"),
    "color": ("specular_reflectance", "reflectance"),
    "flakecolor": ("colors", "specular_reflectance"),
    "glittercolor": ("colors", "specular_reflectance"),
    "albedo": ("reflectance", "specular_reflectance"),
    "flakescale": ("to_uv",),
    "uvscale": ("to_uv",),
    "scale": ("to_uv",),
    "bumpheight": ("height_scale",),
    "bumpscale": ("height_scale",),
    "displacementscale": ("height_scale",),
    "normalstrength": ("strength",),
    "normalscale": ("strength",),
    "flipgreen": ("flip_y",),
    "normalmap": ("filename",),
    "heightmap": ("filename",),
    "texture": ("filename",),
    "file": ("filename",),
    "ior": ("int_ior",),
}


def declared(owner: str, name: str) -> Number | Kind | None:
    """The declaration of a parameter, or None where there is none."""
    return PARAMETERS.get(owner, {}).get(name)


def declared_range(owner: str, name: str, otherwise: Number = ANY) -> Number:
    """The declared range of a number; ``otherwise`` if there is no declaration."""
    found = declared(owner, name)
    return found if isinstance(found, Number) else otherwise


class Parameters:
    """Reads the properties of one plugin; every method raises ``ParameterError`` for bad values."""

    def __init__(self, props: mi.Properties) -> None:
        self.props = props
        self.owner = props.plugin_name()

    def refuse_unknown(self) -> None:
        """Refuse names that the plugin does not have; the error suggests one that is alike."""
        known = PARAMETERS.get(self.owner)
        if known is None:
            return
        for name in self.props.keys():
            if name not in known and name != "deferred":  # the loader of a scene sets this one
                others = OTHER_NAMES.get(name.lower().replace("_", ""), ())
                alike = [other for other in others if other in known]
                alike = alike or get_close_matches(name, known, 1, 0.6)
                hint = f', did you mean "{alike[0]}"?' if alike else f": it has {', '.join(known)}"
                raise ParameterError(f'{self.owner}: "{name}" is not a parameter{hint}')

    # ----------------------------------------------------------------------------------------------
    #  Simple values
    # ----------------------------------------------------------------------------------------------

    def number(self, name: str, default: float) -> float:
        """A number in the declared range."""
        value = self.props.get(name, default)
        allowed = declared_range(self.owner, name)
        check(allowed.holds(value), self.owner, name, str(allowed), value)
        return float(value)

    def number_or_texture(self, name: str, default: float) -> float | mi.Texture:
        """A number of the declared range, or a texture, which has checked itself."""
        value = self.props.get(name, default)
        if isinstance(value, mi.Texture):
            return value
        allowed = declared_range(self.owner, name)
        check(allowed.holds(value), self.owner, name, f"{allowed}, or a texture", value)
        return float(value)

    def whole(self, name: str, default: int | None) -> int | None:
        """A whole number in the declared range, or the default, which may be None."""
        if name not in self.props:
            return default
        value = self.props[name]
        allowed = declared_range(self.owner, name, Number(0, 2**32 - 1, whole=True))
        check(allowed.holds(value), self.owner, name, str(allowed), value)
        return value

    def per_axis(self, name: str, default: float) -> tuple[float, float]:
        """The numbers ``name_u`` and ``name_v``, or ``name`` for both, in the declared range."""
        axes = (f"{name}_u", f"{name}_v")
        self.only_one_of((name,), axes)
        if name in self.props:
            default = self.number(name, default)
        return tuple(self.number(axis, default) for axis in axes)

    def written(self, name: str, axis: str) -> str:
        """The name by which the value along an axis was given: ``name``, or ``name_u``,
        ``name_v``."""
        return name if name in self.props else f"{name}_{axis}"

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

    def share(self, name: str) -> float | str:
        """``auto``, the default, or a number from 0 to 1."""
        value = self.props.get(name, "auto")
        fits = value == "auto" if isinstance(value, str) else Number(0, 1).holds(value)
        check(fits, self.owner, name, str(SHARE), value)
        return value

    def only_one_of(self, *groups: tuple[str, ...]) -> None:
        """Refuse properties from more than one of the ``groups``, as they contradict each other."""
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
        """The map from ``filename``, ``bitmap`` or ``data``.

        ``mi.file_resolver()`` resolves relative file names, relative to the scene's folder.
        ``instead`` is a parameter that may be given in place of a map; the error message names it.
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
            "height_scale": self.number("height_scale", 1.0),
            "wrap_mode": self.choice("wrap_mode", "repeat", WRAP_MODES),
            "encoding": self.choice("encoding", "auto", ENCODINGS),
            "strength": self.number("strength", 1.0),
            "fill_voids": self.boolean("fill_voids", False),
            "flip_y": self.boolean("flip_y", False),
            "owner": self.owner,
        }
        return self._read_map(source, value, options)

    def _read_map(self, source: str, value: object, options: dict) -> NormalMap:
        if source == "filename":
            check(isinstance(value, str), self.owner, source, "a string", value)
            layer = self.props.get("layer", "")
            check(isinstance(layer, str), self.owner, "layer", "a string", layer)
            path = Path(str(mi.file_resolver().resolve(value)))
            return NormalMap.load(path, layer=layer, **options)
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

    def given_transform(self, name: str) -> mi.ScalarAffineTransform4f:
        """A transform as it was given, the identity where it was not."""
        value = self.props.get(name, mi.ScalarAffineTransform4f())
        right = name not in self.props or self.props.type(name) == mi.Properties.Type.Transform
        check(right, self.owner, name, "a transform", value)
        return value

    def transform(self, name: str) -> mi.ScalarAffineTransform4f:
        """A transform of space, which must be finite and invertible."""
        value = mi.ScalarAffineTransform4f(self.given_transform(name).matrix)
        check_transform(self.owner, name, value)
        return value

    def color(self, name: str) -> tuple[float, ...]:
        """A colour of linear RGB in [0, 1], or a number for grey."""
        value, kind = self.props[name], self.props.type(name)
        numeric = {mi.Properties.Type.Float, mi.Properties.Type.Integer}
        numbers: list = [value] * 3 if kind in numeric else []
        if kind == mi.Properties.Type.Color:
            numbers = list(value)  # type: ignore[call-overload]
        right = len(numbers) > 0 and all(0 <= x <= 1 for x in numbers)
        check(right, self.owner, name, "a colour of numbers from 0 to 1", value)
        return tuple(float(x) for x in numbers)

    def to_uv(self) -> mi.ScalarAffineTransform3f:
        """The transform of UV space. It must be finite and its linear part invertible."""
        value = self.given_transform("to_uv")
        to_uv = mi.ScalarAffineTransform3f(value.extract().matrix)  # type: ignore[attr-defined]
        check_to_uv(self.owner, to_uv)
        return to_uv

    # ----------------------------------------------------------------------------------------------
    #  Colours
    # ----------------------------------------------------------------------------------------------

    def colors(self, name: str, choices: tuple[str, ...]) -> str | np.ndarray:
        """One of the strings ``choices``, or the colours of an image: linear RGB, N×3, float32.

        The image is an ``mi.Bitmap``, or a file, whose name is resolved like the file name of a
        map. Integer pixels are sRGB unless the bitmap says otherwise, as everywhere in Mitsuba.
        Colours must be finite and ≥ 0.
        """
        value = self.props.get(name, choices[0])
        if isinstance(value, str) and value in choices:
            return value
        requirement = f"one of {', '.join(choices)}, the name of an image file or an mi.Bitmap"
        bitmap = value
        if isinstance(value, str):
            if dr.thread_count() < 2:  # Mitsuba hangs when it reads OpenEXR files with one thread
                dr.set_thread_count(2)
            path = Path(str(mi.file_resolver().resolve(value)))
            check(is_file(path), self.owner, name, requirement, value)
            try:
                bitmap = mi.Bitmap(str(path))
            except RuntimeError as error:
                raise ParameterError(
                    f'{self.owner}: "{name}" must be a readable image file '
                    f"(got {describe(value)}: {' '.join(str(error).split())})"
                ) from error
        check(isinstance(bitmap, mi.Bitmap), self.owner, name, requirement, value)
        kind = mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32
        pixels = np.array(bitmap.convert(*kind, False))  # type: ignore[attr-defined]
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

    def interface(self) -> Interface:
        """The interface of the facets, from ``material``, or ``eta`` and ``k``, or ``int_ior`` and
        ``ext_ior``. The default is a perfect mirror, which adds no code to a kernel."""
        self.only_one_of(("material",), ("eta", "k"), ("int_ior", "ext_ior"))
        props = self.props
        if "int_ior" in props or "ext_ior" in props:
            return Dielectric(self.ior("int_ior", "bk7") / self.ior("ext_ior", "air"))
        if "eta" in props or "k" in props:
            most = EXTINCTION.maximum
            return Conductor(self.spectrum("eta", 0.0, most), self.spectrum("k", 1.0, most))
        material = props.get("material", "none")
        check(isinstance(material, str), self.owner, "material", "a string", material)
        if material != "none":
            return Conductor(*self.conductor_preset(material))
        return Mirror()

    def specular_reflectance(self) -> mi.Texture | None:
        """The factor on the reflection, in [0, 1]; None if it is not given, for no code in a
        kernel."""
        if "specular_reflectance" not in self.props:
            return None
        return self.spectrum("specular_reflectance", 1.0, 1.0)

    def spectrum(self, name: str, default: float, maximum: float) -> mi.Texture:
        """A number, colour, spectrum or texture with values from 0 to ``maximum``, as a texture.

        Only numbers are checked here: textures check themselves.
        """
        value = self.props.get(name, default)
        numeric = {
            mi.Properties.Type.Integer: lambda: [value],
            mi.Properties.Type.Float: lambda: [value],
            mi.Properties.Type.Color: lambda: list(value),
            mi.Properties.Type.Spectrum: lambda: list(value.values),  # type: ignore[attr-defined]
        }
        kind = self.props.type(name) if name in self.props else mi.Properties.Type.Float
        check(
            isinstance(value, mi.Texture)
            or (kind in numeric and all(0 <= x <= maximum for x in numeric[kind]())),
            self.owner,
            name,
            f"a number, colour, spectrum or texture of values from 0 to {maximum:g}",
            value,
        )
        # get_texture bounds colours by 1, which is right for a reflectance but not for an index.
        if maximum <= 1:
            return self.props.get_texture(name, default)
        return self.props.get_unbounded_texture(name, default)

    def ior(self, name: str, default: str) -> float:
        """An index of refraction: a number or the name of one of Mitsuba's presets."""
        value = self.props.get(name, default)
        if isinstance(value, str):
            named = mi.Properties()
            named[name] = value
            try:
                return mi.lookup_ior(named, name, default)
            except RuntimeError as error:
                choices = str(error).partition("Valid choices are:")[2].strip()
                raise ParameterError(
                    f'{self.owner}: "{name}" must be {INDICES} or one of '
                    f"{' '.join(choices.split())} (got {describe(value)})"
                ) from None
        requirement = f"{INDICES} or the name of a material"
        check(INDICES.holds(value), self.owner, name, requirement, value)
        return float(value)

    def conductor_preset(self, material: str) -> tuple[mi.Texture, mi.Texture]:
        """The textures eta and k of one of Mitsuba's metals, from its ``conductor`` plugin."""

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
        # Taken out of the dictionary: the class above is part of a reference cycle, and lives on
        # with everything in its closure.
        return found.pop("eta"), found.pop("k")


def check_to_uv(owner: str, to_uv: mi.ScalarAffineTransform3f) -> None:
    """Raise :class:`~.ParameterError` unless a transform of the UV plane is invertible, and no
    entry is beyond :data:`LARGEST_ENTRY`."""
    matrix = to_uv.matrix
    entries = [float(matrix[row, column]) for row in range(2) for column in range(3)]
    determinant = entries[0] * entries[4] - entries[1] * entries[3]
    check(
        all(abs(entry) <= LARGEST_ENTRY for entry in entries) and determinant != 0,
        owner,
        "to_uv",
        f"a finite, invertible transform of the UV plane, with entries up to {LARGEST_ENTRY:g}",
        entries,
    )


def check_transform(owner: str, name: str, transform: mi.ScalarAffineTransform4f) -> None:
    """Refuse a transform of space that is not invertible, or beyond :data:`LARGEST_ENTRY`."""
    matrix = np.array(transform.matrix, np.float64)
    check(
        (np.abs(matrix) <= LARGEST_ENTRY).all() and np.linalg.det(matrix[:3, :3]) != 0,
        owner,
        name,
        f"a finite, invertible transform, with entries up to {LARGEST_ENTRY:g}",
        matrix.tolist(),
    )
