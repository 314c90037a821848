"""Effects on the body and on the reflections of any material: exact colours, and highlights.

Both make a whole table first and mix it with what lies below by the weight, so that soft paint goes
straight from one to the other.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.effects import (
    KINDS,
    Applied,
    Effect,
    Named,
    Palette,
    body_of,
    mixed,
    table_name,
)
from traitbrdf.formats.display import decode_srgb, encode_srgb
from traitbrdf.reflectance.brdf import (
    ALBEDO_ANGLES,
    HalfDiffGrid,
    TabulatedBRDF,
    albedo_operator,
)
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.logmap import log_map
from traitbrdf.space.material import Material

__all__ = ["Colour", "Highlight"]

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_FULL = 0.997
"""Greatest directional albedo that effects lead to: decoding takes away what passes 1."""

_SHAPED = 0.1
"""Albedo of a body from which its angular shape is kept; a black one becomes Lambertian."""


@functools.lru_cache(maxsize=4)
def _albedo_rows(grid: HalfDiffGrid) -> Float32:
    """Return what takes a table to its directional albedo at 16 angles: (16, cells)."""
    return np.asarray(albedo_operator(grid, ALBEDO_ANGLES).toarray(), np.float32)


def body_albedo(material: Material, embedding: BRDFEmbedding) -> Float64:
    """Return the albedo (3,) of a material's body, linear Rec.709.

    It is the directional albedo of min(f, b), as `Tint` splits f, averaged over light from all
    sides: at angles up to 80 degrees, weighted by cos(theta) sin(theta).

    Parameters
    ----------
    material : Material
    embedding : BRDFEmbedding
    """
    return _mean_albedo(body_of(material.values(embedding), embedding.grid_), embedding.grid_)


def _mean_albedo(values: Float32, grid: HalfDiffGrid) -> Float64:
    weight = np.cos(ALBEDO_ANGLES) * np.sin(ALBEDO_ANGLES)
    return np.asarray(weight @ (_albedo_rows(grid) @ values) / weight.sum(), np.float64)


def _made(values: Float32, material: Material, embedding: BRDFEmbedding) -> Material:
    """Return the material of a table that was made of another's."""
    grid = embedding.grid_
    logs = np.ascontiguousarray(log_map(values).T)[None]
    moved = embedding.least_squares(logs)[0] - material.least_squares(embedding)
    z = embedding.clip(material.z + moved)
    table = TabulatedBRDF(grid, values.reshape(*grid.shape, 3))
    return Material(
        z,
        material.mirror,
        embedding.residual(table, z),
        None,
        material.name,
    )


@dataclass(frozen=True, repr=False)
class Colour(Effect):
    """Set the colour of the body: ``tb.Colour((0.5, 0.1, 0.1))`` or ``tb.Colour("#b03030")``.

    Parameters
    ----------
    rgb : (3,) array_like, or str
        Albedo of the body in linear Rec.709 (see `body_albedo`), in [0, 1]; or display values in
        [0, 1] if `space` is "srgb"; or "#rrggbb", which always are display values.
    space : "linear" or "srgb"

    Raises
    ------
    ValueError, TypeError
        On numbers outside of [0, 1], another space, or text that is no colour.

    Notes
    -----
    Reflections stay as they are. A black body, such as a metal's, gets a Lambertian one. Where body
    and reflections together would reflect more light than arrives, the nearest reachable colour is
    taken, channel by channel; `EditSession.set_colour` refuses the other and names this one. A
    weight below 1 is a mixture.

    Examples
    --------
    >>> Colour("#ff8000")
    tb.Colour('#ff8000')
    """

    rgb: tuple[float, float, float] | str
    space: str = "linear"

    def __post_init__(self) -> None:
        if self.space not in ("linear", "srgb"):
            raise ValueError(f"space: expected 'linear' or 'srgb', got {self.space!r}")
        if isinstance(self.rgb, str):
            _from_code(self.rgb)
            return
        try:
            given = np.asarray(self.rgb, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"rgb: expected three numbers or '#rrggbb', got {self.rgb!r}") from None
        if given.shape != (3,) or not ((given >= 0.0) & (given <= 1.0)).all():
            raise ValueError(f"rgb: expected three numbers in [0, 1], got {self.rgb!r}")
        object.__setattr__(self, "rgb", tuple(given.tolist()))

    @property
    def linear(self) -> Float64:
        """The albedo asked for, (3,) in linear Rec.709."""
        if isinstance(self.rgb, str):
            return decode_srgb(_from_code(self.rgb))
        return decode_srgb(self.rgb) if self.space == "srgb" else np.array(self.rgb)

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Go a share `weight` of the way to the colour; see `Effect.apply`."""
        if weight <= 0.0:
            return Applied(material)
        whole, reached = _coloured(self, material, palette.embedding)
        short = np.abs(reached - self.linear).max() > 1e-3
        return Applied(mixed(material, whole, weight, palette.embedding), refused=bool(short))

    def check(self, material: Material, applied: Applied, palette: Palette) -> None:
        """Raise ValueError where the colour would reflect more light than arrives."""
        if applied.refused:
            _, reached = _coloured(self, material, palette.embedding)
            linear = ", ".join(f"{c:.3f}" for c in reached)
            code = "#" + "".join(f"{c:02x}" for c in encode_srgb(reached))
            raise ValueError(
                f"rgb: expected a colour that the material can have beside its reflections, got "
                f"{self.rgb!r}; the nearest is ({linear}), {code}"
            )

    def call(self, target: str, named: Named = table_name) -> str:
        """Return the call of `EditSession.set_colour`, as Python source; see `Effect.call`."""
        return f"edit.set_colour({target}, {self._arguments(named)})"


def _from_code(code: str) -> Float64:
    """Return the display values (3,) of "#rrggbb"."""
    try:
        if len(code) == 7 and code[0] == "#":
            return np.array([int(code[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    except ValueError:
        pass
    raise ValueError(f"rgb: expected a colour such as '#ff8000', got {code!r}")


@functools.lru_cache(maxsize=32)
def _coloured(
    colour: Colour, material: Material, embedding: BRDFEmbedding
) -> tuple[Material, Float64]:
    """Return a material whose body has a colour, and the albedo (3,) that its body has."""
    grid, rows = embedding.grid_, _albedo_rows(embedding.grid_)
    values = material.values(embedding)
    body = body_of(values, grid)
    rest = values - body
    own = _mean_albedo(body, grid)
    # all channels get the angular shape of the brightest: dark ones are noise
    brightest = int(np.argmax(own))
    share = min(own[brightest] / _SHAPED, 1.0)
    shape = share * body[:, brightest] / max(own[brightest], 1e-9) + (1.0 - share) / math.pi
    shape = np.asarray(shape / _mean_albedo(shape[:, None], grid), np.float32)
    room = (_FULL - rows @ rest) / np.maximum(rows @ shape, 1e-9)[:, None]
    wanted = np.minimum(colour.linear, np.maximum(room.min(axis=0), 0.0))
    factors, reached = wanted.copy(), wanted
    for _ in range(6):  # the split of the result is another than that of what it was made of
        made = np.asarray(rest + shape[:, None] * factors.astype(np.float32), np.float32)
        reached = _mean_albedo(body_of(made, grid), grid)
        if np.abs(reached - wanted).max() < 2e-4:
            break
        factors = np.clip(factors * wanted / np.maximum(reached, 1e-9), 0.0, room.min(axis=0))
        factors = np.maximum(factors, 0.0)
    return _made(made, material, embedding), reached


@dataclass(frozen=True, repr=False)
class Highlight(Effect):
    """Change the reflections: ``tb.Highlight(blur=2.0)``, or add a lobe.

    Parameters
    ----------
    blur : float
        Factor of the width of all reflections, which keep their energy: above 1 blurs, below 1
        sharpens.
    intensity : float
        Factor of all reflections, at least 0: 0.5 takes half of them away.
    strength : float
        f in 1/sr at the crest of a lobe that is added; 0 is none.
    at : float
        theta_h of its crest in degrees, in [0, 80]: 0 is the mirror direction, above that the lobe
        is a ring around it.
    width : float
        Full width of the lobe at half its height, in degrees of theta_h, in [0.1, 90].
    rgb : (3,) array_like
        Its colour, linear Rec.709 in [0, 1].

    Raises
    ------
    ValueError, TypeError
        On numbers out of range, or that are not finite.

    Notes
    -----
    f depends on theta_h, theta_d and phi_d as before, so it stays reciprocal. Where the result
    would reflect more light than arrives, the lobe that is added is lowered first, then reflections
    are: the body stays. The added lobe falls with cos(theta_d), so that it ends at grazing light.
    A weight below 1 is a mixture.
    """

    blur: float = 1.0
    intensity: float = 1.0
    strength: float = 0.0
    at: float = 0.0
    width: float = 10.0
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        ranges = {
            "blur": (0.05, 20.0), "intensity": (0.0, 1e6), "strength": (0.0, 1e6),
            "at": (0.0, 80.0), "width": (0.1, 90.0),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
                raise TypeError(f"{name}: expected a number, got {value!r}")
            if not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name}: expected {low:g} to {high:g}, got {value!r}")
            object.__setattr__(self, name, float(value))
        rgb = self.rgb
        if not isinstance(rgb, (Sequence, np.ndarray)) or len(rgb) != 3:
            raise TypeError(f"rgb: expected three numbers, got {rgb!r}")
        colour = np.asarray(rgb, np.float64)
        if not ((colour >= 0.0) & (colour <= 1.0)).all():
            raise ValueError(f"rgb: expected three numbers in [0, 1], got {rgb!r}")
        object.__setattr__(self, "rgb", tuple(colour.tolist()))

    def apply(self, material: Material, weight: float, palette: Palette) -> Applied:
        """Go a share `weight` of the way; see `Effect.apply`."""
        if weight <= 0.0:
            return Applied(material)
        whole = _highlit(self, material, palette.embedding)
        return Applied(mixed(material, whole, weight, palette.embedding))

    def _arguments(self, named: Named = table_name) -> str:
        return ", ".join(
            f"{f.name}={getattr(self, f.name)!r}"
            for f in dataclasses.fields(self)
            if getattr(self, f.name) != f.default
        )

    def lobe(self, grid: HalfDiffGrid) -> Float64:
        """Return the added lobe (cells,) of strength 1.

        Parameters
        ----------
        grid : HalfDiffGrid
        """
        theta_h, theta_d, _ = grid.node_angles()
        off = (theta_h - math.radians(self.at)) / math.radians(self.width)
        shape = np.exp(-4.0 * math.log(2.0) * off**2) * np.cos(theta_d)
        return np.broadcast_to(shape, grid.shape).reshape(-1).astype(np.float64)


@functools.lru_cache(maxsize=32)
def _highlit(effect: Highlight, material: Material, embedding: BRDFEmbedding) -> Material:
    grid, rows = embedding.grid_, _albedo_rows(embedding.grid_)
    values = material.values(embedding)
    body = body_of(values, grid)
    rest = values - body
    mirror = material.mirror
    if effect.blur != 1.0:
        rest = _blurred(rest, grid, effect.blur)
    if effect.intensity != 1.0:
        rest = np.asarray(rest * effect.intensity, np.float32)
        mirror = np.minimum(mirror * effect.intensity, 1.0)
    rest = rest * np.float32(_fitting(rows @ body, rows @ rest))
    made = body + rest
    if effect.strength > 0.0:
        lobe = (effect.strength * effect.lobe(grid))[:, None] * np.array(effect.rgb)
        lobe = lobe.astype(np.float32)
        made = made + lobe * np.float32(_fitting(rows @ made, rows @ lobe))
    whole = _made(np.asarray(made, np.float32), material, embedding)
    return dataclasses.replace(whole, mirror=mirror)


def _fitting(below: Float32, added: Float32) -> float:
    """Return the greatest share, up to 1, of an albedo that fits on top of another."""
    room = np.maximum(_FULL - below, 0.0)
    over = added > room
    return float((room[over] / added[over]).min()) if over.any() else 1.0


def _blurred(values: Float32, grid: HalfDiffGrid, factor: float) -> Float32:
    """Return reflections (cells, 3) that are wider by a factor and keep their energy.

    What falls with theta_h is stretched from the mirror direction, and what rises again, such as
    the rim of velvet, from 90 degrees: stretched from 0 it would leave the hemisphere.
    """
    table = values.reshape(len(grid.theta_h), -1, 3)
    falling = np.minimum.accumulate(table, axis=0)
    out = np.zeros_like(table)
    for part, centre, power in ((falling, 0.0, 2), (table - falling, grid.theta_h[-1], 1)):
        wide = _stretched(part, grid.theta_h, centre, factor)
        before, after = (float(_mean_albedo(v.reshape(-1, 3), grid).sum()) for v in (part, wide))
        # a lobe's solid angle goes with factor^2, a rim's with factor; where more is lost than
        # that, as at the end of the hemisphere, a share stays as it is
        gain = min(before / max(after, 1e-12), max(1.0, 2.0 / factor**power))
        stays = max(1.0 - gain * after / max(before, 1e-12), 0.0)
        out += gain * wide + stays * part
    return np.asarray(out.reshape(-1, 3), np.float32)


def _stretched(table: Float32, theta_h: Float64, centre: float, factor: float) -> Float32:
    """Return a table (theta_h, ..., 3) stretched along theta_h around an angle."""
    source = centre + (theta_h - centre) / factor
    place = np.interp(source, theta_h, np.arange(len(theta_h)))
    low = np.minimum(place.astype(np.int64), len(place) - 2)
    share = (place - low).astype(np.float32)[:, None, None]
    found = (1.0 - share) * table[low] + share * table[low + 1]
    found[(source < 0.0) | (source > theta_h[-1])] = 0.0
    return np.asarray(found, np.float32)


for _kind in (Colour, Highlight):
    KINDS[_kind.__name__] = _kind
