"""Conversion of an image's numbers to projected normals, and the choice of their interpretation.

The type of a file decides little: normals in [-1, 1] and normals stored as (n + 1)/2 both
come as floating-point numbers, heights come in three channels, and normals in one of colour and one
of alpha. So ``auto`` examines the numbers. Every decision that has a plausible alternative is
a :class:`Note`, one sentence with a remedy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from glintbsdf.core.errors import check, check_choice

WRAP_MODES = ("repeat", "mirror", "clamp")
MAP_TYPES = ("auto", "normal", "height")
ENCODINGS = ("auto", "signed", "unsigned")

MAX_SLOPE = 1000

_LEVEL = 1 / 255  # one step of an 8-bit file, from which most files of more bits come
_FEW_LEVELS = 4 * _LEVEL

# Heights that elevation models give to places without data.
_VOID_HEIGHTS = (-9999, -32767, -32768)


class Note(NamedTuple):
    """A decision: what it was, and whether another reading is plausible."""

    text: str
    doubtful: bool = True


@dataclass
class Decoding:
    """Conversion of the numbers of an image to normals.

    Attributes:
        map_type: ``auto``, ``normal`` or ``height``. By ``auto``, one channel is a height, and so
            are three that are equal except for a few levels of 8 bits.
        height_scale: texels per unit of height; may be negative.
        wrap_mode: ``repeat``, ``mirror`` or ``clamp``.
        encoding: how normals are stored. ``signed``: components in [-1, 1]; ``unsigned``: stored
            as (n + 1)/2; ``auto``: whichever of the two makes the vectors unit normals. Integers
            count as fractions of their range.
        flip_y: whether the second component of normals points the other way (DirectX).
        strength: factor on the slopes.
        fill_voids: whether texels that hold nothing take the normal of the nearest texel that does.
            A texel holds nothing where a value is NaN or infinite; where its alpha is 0 and others
            have more; where a height is -9999, -32767, -32768, below -1e30 or the value that the
            file names; where a normal has length 0, or is stored as black.
        owner, parameter: names for error messages.
        void: the value that the file gives to places without data, if it names one.
        notes: what has been decided.
        reads_height: whether it was a height.

    Raises:
        ParameterError: a value that is not allowed.
    """

    map_type: str = "auto"
    height_scale: float = 1.0
    wrap_mode: str = "repeat"
    encoding: str = "auto"
    flip_y: bool = False
    strength: float = 1.0
    fill_voids: bool = False
    owner: str = "NormalMap"
    parameter: str = "data"
    void: float | None = None
    notes: list[Note] = field(default_factory=list)
    reads_height: bool = False

    def __post_init__(self) -> None:
        check_choice(self.owner, "map_type", self.map_type, MAP_TYPES)
        check_choice(self.owner, "wrap_mode", self.wrap_mode, WRAP_MODES)
        check_choice(self.owner, "encoding", self.encoding, ENCODINGS)
        for name in ("height_scale", "strength"):
            value = getattr(self, name)
            check(bool(np.isfinite(value)), self.owner, name, "a finite number", value)

    def normals(self, data: np.ndarray) -> np.ndarray:
        """H x W x 2 projected normals, x² + y² < 1, of H x W x C values, C = 1…4.

        Raises:
            ParameterError: the values are no valid map, or some have no normal; the message names
                the first place.
        """
        void = np.zeros(data.shape[:2], bool)
        if data.shape[2] == 4:
            data, alpha = data[..., :3], _as_fractions(data[..., 3])
            if self.map_type != "height" and _is_swizzled(data, alpha):
                self.note(
                    "x is taken from the alpha channel and y from green, as compressed normal maps "
                    '(DXT5nm) have them; map_type "height" reads the colours as a height'
                )
                data, self.map_type = (
                    np.stack((_of_type(alpha, data), data[..., 1]), axis=2),
                    "normal",
                )
                alpha = None
            if alpha is not None:
                self.check(
                    bool(np.all((alpha >= 0) & (alpha <= 1))),
                    "a map whose fourth channel is an alpha in [0, 1]",
                    f"a fourth channel from {alpha.min():.6g} to {alpha.max():.6g}",
                )
                if self.fill_voids and alpha.any():
                    void = alpha == 0

        self.reads_height = self.is_height(data)
        if self.reads_height:
            # The middle one of three is what two of them agree on.
            height = data[..., 0] if data.shape[2] == 1 else np.median(data, axis=2)
            return self.of_height(height.astype(data.dtype, copy=False), void)
        self.check(data.shape[2] > 1, "normals, of two or three channels", "1 channel")
        return self.of_vectors(data, void)

    # ----------------------------------------------------------------------------------------------
    #  Heights
    # ----------------------------------------------------------------------------------------------

    def is_height(self, data: np.ndarray) -> bool:
        """Whether the channels hold a height: ``map_type`` says so, or they are alike."""
        channels = data.shape[2]
        if self.map_type == "normal" or (self.map_type == "auto" and channels == 2):
            return False
        if channels == 1:
            return True
        if channels == 2:
            self.check(False, "a height, one channel or three equal ones", "2 channels")
        spread = float(_differences(data).max())
        if spread == 0:
            return True
        is_height = _alike(data) or _tinted(data)
        if self.map_type == "height":
            self.check(
                is_height, "a height, one channel or three equal ones", "3 channels that differ"
            )
        elif is_height:
            self.note(
                f"its three channels show the same but for {spread:.2g} of their range, so it is "
                'read as a height; map_type "normal" reads them as normals'
            )
        return is_height

    def of_height(self, height: np.ndarray, void: np.ndarray) -> np.ndarray:
        """``n ∝ (-∂h/∂x, -∂h/∂y, 1)`` by central differences, in texels.

        A texel beside a void one takes the difference to its other neighbour.
        """
        self.check(not self.flip_y, "false for a height, which has no green", True, "flip_y")
        if self.fill_voids:
            void = void | ~np.isfinite(height) | np.isin(height, _VOID_HEIGHTS) | (height < -1e30)
            if self.void is not None:
                void |= height == self.void
        height = _as_fractions(height)
        remedy = "" if self.fill_voids else ' (or "fill_voids" true)'
        self.check_texels(
            f"finite heights{remedy}", {"NaN or infinite": ~np.isfinite(height) & ~void}
        )
        height = np.where(void, 0, height)
        # Mirrored about the border, the texel beyond is the border texel itself, as when clamped.
        mode: Literal["wrap", "edge"] = "wrap" if self.wrap_mode == "repeat" else "edge"
        padded = np.pad(height, 1, mode=mode)
        scale = float(self.height_scale) * float(self.strength)
        neighbours = (
            ((slice(1, -1), slice(2, None)), (slice(1, -1), slice(None, -2))),
            ((slice(2, None), slice(1, -1)), (slice(None, -2), slice(1, -1))),
        )
        absent = np.pad(void, 1, mode=mode) if void.any() else None
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            slopes = []
            for after, before in neighbours:
                if absent is None:
                    slopes.append(0.5 * scale * (padded[after] - padded[before]))
                    continue
                ahead = np.where(absent[after], height, padded[after])
                behind = np.where(absent[before], height, padded[before])
                steps = 2 - absent[after].astype(int) - absent[before]
                slopes.append(scale * (ahead - behind) / np.maximum(steps, 1))
            slope_x, slope_y = slopes
            length = np.hypot(np.hypot(slope_x, slope_y), 1)
        # Steeper ones would be horizontal in float32.
        self.check_texels(
            f"a height with slopes below {MAX_SLOPE}, after height_scale{remedy}",
            {"steeper": ~(length < MAX_SLOPE) & ~void},
        )
        return self.filled(np.stack((-slope_x / length, -slope_y / length), axis=2), void)

    # ----------------------------------------------------------------------------------------------
    #  Normals
    # ----------------------------------------------------------------------------------------------

    def of_vectors(self, data: np.ndarray, void: np.ndarray) -> np.ndarray:
        """Projected normals of two or three components, whatever their encoding and length."""
        vectors = _as_fractions(data)
        stored = self.is_stored(vectors, data.dtype)
        if stored:
            vectors = 2 * vectors - 1
        finite = np.isfinite(vectors).all(axis=2)
        if data.shape[2] == 3:
            # A stored normal of length 0 is rounded: grey, which leans along the diagonal instead.
            zero = (np.abs(vectors) < 2 * _LEVEL).all(axis=2) if stored else ~vectors.any(axis=2)
            black = (vectors < -1 + 16 * _LEVEL).all(axis=2) & stored
            if self.fill_voids:
                void = void | ~finite | zero | black
            remedy = "" if self.fill_voids else '; "fill_voids" true fills those without one'
            self.check_texels(
                f"normals that are finite, non-zero and face up, z > 0{remedy}",
                {
                    "NaN or infinite": ~finite & ~void,
                    "zero": zero & ~void,
                    "down-facing": finite & ~zero & ~void & ~(vectors[..., 2] > 0),
                },
            )
            self.look_at_lengths(vectors, stored, ~void & finite)
            length = np.sqrt(np.einsum("ijk,ijk->ij", vectors, vectors, dtype=np.float64))
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # of void texels
                xy = vectors[..., :2] / length[..., None]
        else:
            if self.fill_voids:
                void = void | ~finite | ((vectors < -1 + 16 * _LEVEL).all(axis=2) & stored)
            xy = vectors
        xy = self.filled(xy, void)
        if self.flip_y:
            xy = xy * np.array((1, -1), xy.dtype)
        return xy if self.strength == 1 else self.strengthened(xy)

    def is_stored(self, vectors: np.ndarray, dtype: np.dtype) -> bool:
        """Whether normals are stored as (n + 1)/2: ``encoding`` says so, or the vectors do."""
        if self.encoding != "auto":
            return self.encoding == "unsigned"
        unsigned_type = np.issubdtype(dtype, np.unsignedinteger)
        stored = not _look_plain(vectors) if unsigned_type else _look_stored(vectors)
        reading, other = (
            ("stored as (n + 1)/2 (encoding unsigned)", "signed")
            if stored
            else ("with components in [-1, 1] (encoding signed)", "unsigned")
        )
        self.note(
            f"its {dtype} numbers look like normals {reading}; "
            f'"encoding" {other} reads them otherwise',
            doubtful=stored != unsigned_type,
        )
        return stored

    def look_at_lengths(self, vectors: np.ndarray, stored: bool, valid: np.ndarray) -> None:
        """Note where stored vectors are far from unit length, so that they may be no normals."""
        if not stored or not valid.any():
            return
        sample = vectors[valid][:: max(1, vectors[..., 0].size // 65536)].astype(np.float64)
        length = float(np.median(np.linalg.norm(sample, axis=1)))
        if abs(length - 1) > 0.1:
            self.note(
                f"its vectors have a length of {length:.2f} rather than 1: gamma was undone, or "
                'they are no normals (a height in colours needs map_type "height")'
            )

    def strengthened(self, xy: np.ndarray) -> np.ndarray:
        """Normals whose slopes are ``strength`` times those of the unit normals over ``xy``."""
        xy = xy.astype(np.float64)
        scaled = float(self.strength) * xy
        z_squared = np.maximum(1 - np.einsum("ijk,ijk->ij", xy, xy), 0)
        length = np.sqrt(np.einsum("ijk,ijk->ij", scaled, scaled) + z_squared)
        with np.errstate(invalid="ignore", divide="ignore"):
            return scaled / length[..., None]

    # ----------------------------------------------------------------------------------------------
    #  Filling and telling
    # ----------------------------------------------------------------------------------------------

    def filled(self, normals: np.ndarray, void: np.ndarray) -> np.ndarray:
        """``normals``, where void texels have taken the normal of the nearest one that is not."""
        count = int(np.count_nonzero(void))
        if not count:
            return normals
        self.check(count < void.size, "a map with at least one texel that holds something", "none")
        from scipy.ndimage import distance_transform_edt

        rows, columns = distance_transform_edt(void, return_distances=False, return_indices=True)
        self.note(
            f"{count} of {void.size} texels ({100 * count / void.size:.2g} %) hold nothing, and "
            "take the normal of the nearest that do (fill_voids)"
        )
        return normals[rows, columns]

    def note(self, text: str, doubtful: bool = True) -> None:
        self.notes.append(Note(text, doubtful))

    def check(
        self, condition: bool, requirement: str, got: object, parameter: str | None = None
    ) -> None:
        check(condition, self.owner, parameter or self.parameter, requirement, got)

    def check_texels(self, requirement: str, faults: Mapping[str, np.ndarray]) -> None:
        check_texels(self.owner, self.parameter, requirement, faults)


def check_texels(
    owner: str, parameter: str, requirement: str, faults: Mapping[str, np.ndarray]
) -> None:
    """Raise unless every H x W mask of ``faults`` is empty; tell each count and the first place."""
    counts = {fault: int(np.count_nonzero(mask)) for fault, mask in faults.items()}
    if any(counts.values()):
        row, column = np.argwhere(np.logical_or.reduce(list(faults.values())))[0]
        listed = ", ".join(f"{count} {fault}" for fault, count in counts.items() if count)
        check(
            False,
            owner,
            parameter,
            requirement,
            f"{listed}; the first at row {row}, column {column}",
        )


def curl(normals: np.ndarray) -> tuple[float, float]:
    """Deviation of projected normals from those of a height, as they are and with y reversed.

    The slopes p and q of a height have ``∂p/∂y = ∂q/∂x``. Returned is the mean of the difference of
    both, over the mean of the sum of their magnitudes, in [0, 1]. It is 0 for a height; with y
    reversed the sum takes the place of the difference. Maps of more than a million texels are
    judged by a band of rows. A map without any such derivative gives (0, 0).
    """
    height, width = normals.shape[:2]
    rows = min(height, max(3, (1 << 20) // width))
    band = normals[(height - rows) // 2 :][:rows].astype(np.float64)
    slopes = band / np.sqrt(np.maximum(1 - np.einsum("ijk,ijk->ij", band, band), 1e-6))[..., None]
    if min(slopes.shape[:2]) < 3:
        return 0.0, 0.0
    p_y = slopes[2:, 1:-1, 0] - slopes[:-2, 1:-1, 0]
    q_x = slopes[1:-1, 2:, 1] - slopes[1:-1, :-2, 1]
    total = np.mean(np.abs(p_y) + np.abs(q_x))
    if total == 0:
        return 0.0, 0.0
    return float(np.mean(np.abs(p_y - q_x)) / total), float(np.mean(np.abs(p_y + q_x)) / total)


# --------------------------------------------------------------------------------------------------
#  What numbers look like
# --------------------------------------------------------------------------------------------------


def _as_fractions(data: np.ndarray) -> np.ndarray:
    """Integers as fractions of their range, floats as they are; at least float32."""
    if data.dtype.kind in "ui":
        working_type = np.dtype(np.float32 if data.dtype.itemsize <= 2 else np.float64)
        return data.astype(working_type) / working_type.type(np.iinfo(data.dtype).max)
    return data.astype(np.result_type(data.dtype, np.float32), copy=False)


def _of_type(fractions: np.ndarray, like: np.ndarray) -> np.ndarray:
    """The inverse of :func:`_as_fractions`, for values that came from the type of ``like``."""
    if like.dtype.kind in "ui":
        return np.round(fractions * np.iinfo(like.dtype).max).astype(like.dtype)
    return fractions.astype(like.dtype, copy=False)


def _unit(data: np.ndarray) -> float:
    """The range of the values; for integers, the range of their type."""
    if data.dtype.kind in "ui":
        return float(np.iinfo(data.dtype).max)
    finite = data[np.isfinite(data)]
    return float(finite.max()) - float(finite.min()) if finite.size else 0.0


def _differences(data: np.ndarray) -> np.ndarray:
    """The largest difference of the three channels at every texel, over the range of the values."""
    values = data.astype(np.float32 if data.dtype.itemsize <= 2 else np.float64)
    with np.errstate(invalid="ignore"):
        spread = np.nan_to_num(values.max(axis=2) - values.min(axis=2), posinf=0.0)
    return spread / (_unit(data) or 1)


def _alike(data: np.ndarray) -> bool:
    """Whether three channels are equal up to noise: all but 1 % of texels within a few levels.

    Those of a normal map never are: where x = y = z, normals lean by 55 degrees.
    """
    return bool(np.mean(_differences(data) > _FEW_LEVELS) <= 0.01)


def _tinted(data: np.ndarray) -> bool:
    """Whether three channels show one picture in different shades: correlations above 0.98.

    The components of unit normals cannot all grow together.
    """
    values = data.reshape(-1, 3)[:: max(1, data.shape[0] * data.shape[1] // 65536)]
    values = values[np.isfinite(values).all(axis=1)].astype(np.float64)
    if len(values) < 3 or (values.std(axis=0) <= _FEW_LEVELS * _unit(data)).any():
        return False
    return bool((np.corrcoef(values.T) > 0.98).all())


def _is_swizzled(colours: np.ndarray, alpha: np.ndarray) -> bool:
    """Whether a map keeps x in alpha and y in green, with nothing else in the other colours.

    An alpha that masks is 0 or 1 nearly everywhere; one that carries x is neither, and lies with
    green in the disk of normals.
    """
    green = _as_fractions(colours[..., 1])
    values = _as_fractions(colours)
    if not (np.isfinite(values).all() and np.isfinite(alpha).all()):
        return False
    if values.min() < 0 or values.max() > 1 or alpha.min() < 0 or alpha.max() > 1:
        return False
    others = values[..., (0, 2)]
    constant = bool((np.ptp(others, axis=(0, 1)) <= _FEW_LEVELS).all())
    if not (constant or _alike(colours)) or np.mean((alpha == 0) | (alpha == 1)) > 0.05:
        return False
    x, y = 2 * alpha - 1, 2 * green - 1
    if np.mean(x * x + y * y < 1) < 0.999 or abs(x.mean()) > 0.5 or abs(y.mean()) > 0.5:
        return False
    if np.ptp(alpha) <= _FEW_LEVELS:
        return constant and abs(float(x.mean())) < 2 * _FEW_LEVELS
    apart = sorted(curl(np.stack((x, y), axis=2)))
    return constant or apart[0] < 0.7 * apart[1]


def _look_stored(vectors: np.ndarray) -> bool:
    """Whether fractions look like normals stored as (n + 1)/2 rather than normals as they are.

    Stored normals are nowhere negative. With three components, the reading whose lengths are nearer
    to 1 is right; with two, the reading that lies in the disk and leans less.
    """
    sample = vectors.reshape(-1, vectors.shape[2])
    sample = sample[np.isfinite(sample).all(axis=1)]
    if not sample.size or sample.min() < -_LEVEL / 2 or sample.max() > 1 + _LEVEL / 2:
        return False
    # Black and transparent padding says nothing.
    sample = sample[(sample > _LEVEL).any(axis=1)].astype(np.float64)
    if not sample.size:
        return False
    lengths, decoded = (np.linalg.norm(values, axis=1) for values in (sample, 2 * sample - 1))
    if vectors.shape[2] == 3:
        return bool(np.mean(np.abs(decoded - 1)) < np.mean(np.abs(lengths - 1)))
    return bool(np.mean(decoded >= 1) < 0.001 and decoded.mean() < lengths.mean())


def _look_plain(vectors: np.ndarray) -> bool:
    """Whether unsigned numbers are unit vectors as they are, and as stored ones are not."""
    if vectors.shape[2] != 3:
        return False
    sample = vectors.reshape(-1, 3).astype(np.float64)
    lengths, decoded = (np.linalg.norm(values, axis=1) for values in (sample, 2 * sample - 1))
    return bool(np.mean(np.abs(lengths - 1)) < 0.02 and np.mean(np.abs(decoded - 1)) > 0.1)
