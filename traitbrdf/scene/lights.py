"""Lights: environment maps, point lights and directional lights.

Radiance is linear Rec.709 RGB in W/(m^2 sr). Any common scale works, because everything is linear
in it. An environment map is piecewise constant: every texel has one radiance over its exact solid
angle, in every code path. So two integrators can be compared to the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import number, numbers, whole
from traitbrdf.directions import Array, direction_to_latlong, latlong_to_direction
from traitbrdf.formats.files import FormatError
from traitbrdf.formats.images import Picture, read_picture
from traitbrdf.host import steady

Float64 = NDArray[np.float64]
Layout = Literal["latlong", "angular", "mirrorball"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)


@dataclass(frozen=True)
class PointLight:
    """A point that emits equally in all directions.

    Parameters
    ----------
    position : (3,) world position
    intensity : (3,) radiant intensity RGB in W/sr, not negative

    Raises
    ------
    ValueError
        On anything but three finite numbers.
    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _triple(self.position, "position"))
        object.__setattr__(self, "intensity", _triple(self.intensity, "intensity", low=0.0))

    def arriving(self, points: Float64) -> tuple[Float64, Float64]:
        """Return directions to the light and the irradiance on a surface facing it, both (n, 3).

        Parameters
        ----------
        points : (n, 3) array
            World positions.
        """
        offset = np.asarray(self.position) - points
        squared = np.sum(offset * offset, axis=-1, keepdims=True)
        # at the light itself the direction is undefined: return no light, not infinity
        apart = squared > 1e-200
        safe = np.where(apart, squared, 1.0)
        irradiance = np.where(apart, np.asarray(self.intensity) / safe, 0.0)
        direction = np.where(apart, offset / np.sqrt(safe), (0.0, 1.0, 0.0))
        return direction, irradiance


@dataclass(frozen=True)
class DirectionalLight:
    """A light infinitely far away.

    Parameters
    ----------
    direction : (3,) vector towards the light, of any length but zero
    irradiance : (3,) RGB in W/m^2 on a surface that faces the light, not negative

    Raises
    ------
    ValueError
        On anything but three finite numbers, or a direction of length zero.
    """

    direction: tuple[float, float, float]
    irradiance: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        raw = _triple(self.direction, "direction")
        largest = max(abs(c) for c in raw)
        if largest == 0.0:
            raise ValueError("direction: expected a vector of non-zero length, got (0, 0, 0)")
        scaled = tuple(c / largest for c in raw)  # so that squares neither over- nor underflow
        unit = tuple(c / math.hypot(*scaled) for c in scaled)
        object.__setattr__(self, "direction", unit)
        object.__setattr__(self, "irradiance", _triple(self.irradiance, "irradiance", low=0.0))

    def arriving(self, points: Float64) -> tuple[Float64, Float64]:
        """Return directions to the light and the irradiance on a surface facing it, both (n, 3).

        Parameters
        ----------
        points : (n, 3) array
            World positions.
        """
        shape = points.shape
        return (
            np.broadcast_to(np.asarray(self.direction), shape),
            np.broadcast_to(np.asarray(self.irradiance), shape),
        )


Light = PointLight | DirectionalLight


def _triple(
    value: Sequence[float], name: str, low: float = -math.inf
) -> tuple[float, float, float]:
    a = numbers(value, name).astype(np.float64)
    if a.shape != (3,) or not np.isfinite(a).all() or a.min() < low:
        bound = "" if low == -math.inf else f" of at least {low:g}"
        raise ValueError(f"{name}: expected three finite numbers{bound}, got {value!r}")
    return float(a[0]), float(a[1]), float(a[2])


@steady
class EnvironmentMap:
    """Light from infinitely far away, on a lat-long grid of M rows by N columns.

    Row 0 is the top (+y). The centre of the image shows -z, and +x lies to the right of it (see
    `traitbrdf.directions`). Texel centres are at +0.5.

    Parameters
    ----------
    radiance : (M, N, 3) array_like
        Linear RGB, finite and not negative; stored as float32.
    rotation : float
        Angle in radians by which the map is turned about +y, counter-clockwise seen from above.

    Raises
    ------
    TypeError
        On values that are not real numbers.
    ValueError
        On a wrong shape, an empty map, or radiance that is negative or not finite.
    """

    def __init__(self, radiance: ArrayLike, rotation: float = 0.0) -> None:
        image = np.asarray(radiance)
        if image.ndim != 3 or image.shape[-1] != 3 or 0 in image.shape:
            raise ValueError(f"radiance: expected shape (rows, columns, 3), got {image.shape}")
        if image.dtype in (np.uint8, np.uint16):
            raise TypeError(
                f"radiance: expected linear light as floats, got {image.dtype}, which pictures for "
                "display have: decode them by traitbrdf.formats.display.decode_srgb"
            )
        if not (np.issubdtype(image.dtype, np.number) and np.isrealobj(image)):
            raise TypeError(f"radiance: expected real numbers, got dtype {image.dtype}")
        with np.errstate(over="ignore"):
            image = np.ascontiguousarray(image, dtype=np.float32)
        if fault := _fault(image):
            raise ValueError("radiance: expected {}, got {}".format(*fault))
        rotation = number(rotation, "rotation")
        if image.flags.writeable and np.may_share_memory(image, radiance):
            image = image.copy()  # so that the caller's array is not made read-only below
        self.image = image
        self.image.flags.writeable = False
        self.rotation = float(rotation)
        self.clipped_texels = 0

    def __repr__(self) -> str:
        m, n, _ = self.image.shape
        return f"EnvironmentMap({m}x{n}, rotation={self.rotation:.4g})"

    @classmethod
    def read(cls, path: str | PathLike[str], layout: Layout | None = None) -> EnvironmentMap:
        """Read an HDR image (.exr, .hdr).

        Maps that were shrunk with a sharpening filter undershoot next to bright texels. Negative
        values of at most a quarter of the brightest of the surrounding 7 x 7 texels are taken for
        such undershoot and set to 0, as are colours out of gamut where a file has other primaries
        than Rec.709's; `clipped_texels` counts them. Any other negative value is an error.

        Parameters
        ----------
        path : path-like
        layout : "latlong", "angular" or "mirrorball"
            Without it the file has to be a lat-long map, twice as wide as high, or to say that it
            is a cube map (OpenEXR's ``envmap``). Angular maps (Debevec 1998) have -z at the centre
            and +z at the rim. A mirror ball is the picture of a chrome ball by a distant camera
            that looks along -z: its centre reflects +z. All others are resampled to lat-long,
            bilinearly.

        Raises
        ------
        FileNotFoundError
        ValueError
            On another layout.
        traitbrdf.formats.files.FormatError
            If the file is no such image, its radiance is negative or not finite, or it is no
            lat-long map by its size and no layout is given.
        """
        if layout not in (None, *LAYOUTS):
            raise ValueError(
                f"layout: expected {', '.join(map(repr, LAYOUTS[:-1]))} or {LAYOUTS[-1]!r}, got "
                f"{layout!r}"
            )
        picture = read_picture(path)
        image = picture.pixels
        height, width, _ = image.shape
        if layout is None and not picture.cube and abs(width - 2 * height) > 1:
            raise FormatError(
                path,
                "a lat-long map, twice as wide as high, or a named layout",
                f"{width} x {height} pixels; say layout='angular' or 'mirrorball' if it is one, "
                "or 'latlong' to stretch it over the sphere",
            )
        ringing = (image < 0.0) if picture.converted else _ringing(image)
        image = np.where(ringing, np.float32(0.0), image)
        if fault := _fault(image):
            raise FormatError(path, *fault)
        result = cls(_unwrapped(Picture(image, picture.converted, picture.cube), layout, path))
        result.clipped_texels = int(np.count_nonzero(ringing.any(-1)))
        return result

    @classmethod
    def uniform(cls, radiance: ArrayLike = 1.0, rows: int = 16) -> EnvironmentMap:
        """Return a map with the same radiance from everywhere, as in a white furnace.

        Parameters
        ----------
        radiance : float or (3,) array_like
        rows : int
            Height of the map; it is twice as wide.
        """
        rows = whole(rows, "rows", 1)
        level = numbers(radiance, "radiance").astype(np.float64)
        return cls(np.broadcast_to(level, (rows, 2 * rows, 3)))

    @classmethod
    def sky(
        cls,
        sun: tuple[float, float] | None = (-50.0, 40.0),
        softboxes: bool = True,
        rows: int = 128,
    ) -> EnvironmentMap:
        """Return a procedural sky that needs no file: gradient, ground, sun and two softboxes.

        Parameters
        ----------
        sun : (azimuth, elevation) in degrees, or None
            Azimuth as for `Camera.orbit`: 0 is +z, 90 is +x. The sun is a disc of 3 degrees radius,
            larger than the real one, so that it covers several texels.
        softboxes : bool
            Whether to add two bright rectangles, as in a photographer's studio.
        rows : int
            Height of the map; it is twice as wide.

        Raises
        ------
        ValueError
            If `rows` is not a positive integer.
        """
        rows = whole(rows, "rows", 1)
        v, u = np.meshgrid(
            (np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows),
            indexing="ij",
        )  # fmt: skip
        w = latlong_to_direction(u, v)
        height = w[..., 1:2]
        horizon, zenith = np.array([0.62, 0.68, 0.75]), np.array([0.14, 0.26, 0.55])
        up = np.clip(height, 0.0, 1.0) ** 0.5
        sky = horizon * (1.0 - up) + zenith * up
        ground = np.array([0.20, 0.17, 0.14]) * (1.0 - 0.5 * np.clip(-height, 0.0, 1.0))
        blend = 0.5 + 0.5 * np.clip(height / 0.02, -1.0, 1.0)
        image = ground * (1.0 - blend) + sky * blend
        azimuth = np.degrees(np.arctan2(w[..., 0], w[..., 2]))
        elevation = np.degrees(np.arcsin(np.clip(w[..., 1], -1.0, 1.0)))
        if softboxes:
            for at, half_width, low, high, colour in (
                (62.0, 14.0, 12.0, 58.0, (9.0, 8.6, 8.0)),
                (-118.0, 22.0, 20.0, 44.0, (4.0, 4.6, 5.4)),
            ):
                away = (azimuth - at + 180.0) % 360.0 - 180.0
                inside = (np.abs(away) < half_width) & (elevation > low) & (elevation < high)
                image = np.where(inside[..., None], np.array(colour), image)
        if sun is not None:
            a, e = np.radians([number(angle, "sun") for angle in sun])
            toward = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
            inside = w @ toward > math.cos(math.radians(3.0))
            image = np.where(inside[..., None], np.array([300.0, 270.0, 225.0]), image)
        return cls(image)

    def rotated(self, angle: float) -> EnvironmentMap:
        """Return the map turned further about +y by `angle` radians."""
        return self._like(self.image, self.rotation + number(angle, "angle"))

    def scaled(self, factor: ArrayLike) -> EnvironmentMap:
        """Return the map times `factor`, a number or RGB (3,), not negative."""
        level = numbers(factor, "factor").astype(np.float32)
        return self._like(self.image * level, self.rotation)

    def _like(self, image: NDArray[np.float32], rotation: float) -> EnvironmentMap:
        result = EnvironmentMap(image, rotation)
        result.clipped_texels = self.clipped_texels
        return result

    @property
    def row_edges(self) -> Float64:
        """Polar angles (M + 1,) of the row borders, radians from +y."""
        return np.linspace(0.0, math.pi, self.image.shape[0] + 1)

    @cached_property
    def solid_angles(self) -> Float64:
        """Exact solid angle (M,) of a texel of each row, in sr."""
        edges = self.row_edges
        # cos a - cos b = 2 sin((a + b)/2) sin((b - a)/2), which does not cancel at the poles
        band = 2.0 * np.sin((edges[:-1] + edges[1:]) / 2) * np.sin((edges[1:] - edges[:-1]) / 2)
        return np.asarray(band * (2.0 * math.pi / self.image.shape[1]))

    def to_map(self, w: ArrayLike) -> Array:
        """Turn world directions `w` (..., 3) into the map's own, unrotated frame."""
        return turn_about_y(np.asarray(w), -self.rotation)

    def radiance(self, w: ArrayLike) -> Array:
        """Return the radiance (..., 3) of the texels that world directions `w` (..., 3) hit."""
        m, n, _ = self.image.shape
        u, v = direction_to_latlong(self.to_map(w))
        row = np.clip((v * m).astype(np.int64), 0, m - 1)
        column = (u * n).astype(np.int64) % n
        return np.asarray(self.image[row, column])

    def backdrop(self, w: ArrayLike) -> Array:
        """Return the radiance (..., 3) behind the object in world directions `w` (..., 3).

        It is bilinear between texel centres: constant texels would be visible as blocks.
        """
        n = self.image.shape[1]
        u, v = direction_to_latlong(self.to_map(w))
        return _bilinear(self.image, u * n - 0.5, v * self.image.shape[0] - 0.5, wrap=True)

    def irradiance(self, normals: ArrayLike) -> Float64:
        """Return the irradiance (..., 3) on surfaces with world unit normals `normals` (..., 3).

        The cosine-weighted sum over texels, each at the centroid of its solid angle. It is exact
        for texels that the horizon does not cut.
        """
        n = self.to_map(np.asarray(normals, np.float64))
        flat = n.reshape(-1, 3)
        result = np.zeros(flat.shape)
        for rows in self.bands():
            moment = texel_moments(self, rows).reshape(-1, 3)
            energy = self.image[rows].reshape(-1, 3).astype(np.float64)
            for i in range(0, len(flat), 64):
                result[i : i + 64] += np.maximum(flat[i : i + 64] @ moment.T, 0.0) @ energy
        return result.reshape(n.shape)

    def bands(self, multiple: int = 1) -> Iterator[slice]:
        """Yield bands of rows of some hundred thousand texels, to limit memory in float64.

        Parameters
        ----------
        multiple : int
            The rows of each band but the last are a multiple of it.
        """
        m, n, _ = self.image.shape
        step = multiple * max((1 << 18) // (n * multiple), 1)
        for start in range(0, m, step):
            yield slice(start, min(start + step, m))


def texel_moments(environment: EnvironmentMap, rows: slice = slice(None)) -> Float64:
    """Return the integral (M, N, 3) of the direction over each texel.

    It is the texel's solid angle times its centroid.

    Parameters
    ----------
    environment : EnvironmentMap
        Its rotation is ignored.
    rows : slice
        Rows of the map to compute.
    """
    n = environment.image.shape[1]
    t0, t1 = environment.row_edges[:-1][rows], environment.row_edges[1:][rows]
    f0 = 2.0 * math.pi * np.arange(n) / n
    f1 = 2.0 * math.pi * (np.arange(n) + 1) / n
    # integrals of sin^2 and of sin cos over a row, and of -sin and cos over a column
    across = 0.5 * (t1 - t0) - 0.5 * np.cos(t0 + t1) * np.sin(t1 - t0)
    up = 0.5 * np.sin(t0 + t1) * np.sin(t1 - t0)
    half = 0.5 * (f1 - f0)
    x = -2.0 * np.sin(0.5 * (f0 + f1)) * np.sin(half)
    z = 2.0 * np.cos(0.5 * (f0 + f1)) * np.sin(half)
    moments = np.empty((len(t0), n, 3))
    moments[..., 0] = across[:, None] * x
    moments[..., 1] = (up * (2.0 * math.pi / n))[:, None]
    moments[..., 2] = across[:, None] * z
    return moments


def turn_about_y(w: Array, angle: float) -> Array:
    """Turn vectors `w` (..., 3) about +y by `angle` radians, counter-clockwise seen from above."""
    if angle == 0.0:
        return w
    c, s = math.cos(angle), math.sin(angle)
    return np.stack(
        [c * w[..., 0] + s * w[..., 2], w[..., 1], c * w[..., 2] - s * w[..., 0]], axis=-1
    )


def _fault(image: NDArray[np.float32]) -> tuple[str, str] | None:
    """Return what is expected of radiance (M, N, 3) and what it is; None if it is valid."""
    bad = int(np.count_nonzero(~np.isfinite(image)))
    if bad:
        return (
            "finite float32 radiance",
            f"{bad} values that are not; half-precision files end at 65504: write 32 bits, or "
            "give np.nan_to_num(pixels, posinf=65504) to EnvironmentMap",
        )
    bad = int(np.count_nonzero(image < 0.0))
    if bad:
        return "radiance that is not negative", f"{bad} values down to {image.min():.6g}"
    return None


def _ringing(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask (M, N, 3) of negative values that look like resampling undershoot."""
    if not (image < 0.0).any():
        return np.zeros(image.shape, bool)
    import scipy.ndimage  # slow to import, and few maps have negative texels

    brightest = scipy.ndimage.maximum_filter(image.max(axis=-1), size=7, mode=("nearest", "wrap"))
    mask: NDArray[np.bool_] = (image < 0.0) & (-image <= 0.25 * brightest[..., None])
    return mask


def _bilinear(image: NDArray[np.float32], x: Array, y: Array, wrap: bool) -> Array:
    """Interpolate `image` (M, N, 3) at continuous texel indices x, y (centres at integers)."""
    m, n, _ = image.shape
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    columns = [(x0 + d).astype(np.int64) for d in (0, 1)]
    columns = [c % n if wrap else np.clip(c, 0, n - 1) for c in columns]
    rows = [np.clip((y0 + d).astype(np.int64), 0, m - 1) for d in (0, 1)]
    top = image[rows[0], columns[0]] * (1 - fx) + image[rows[0], columns[1]] * fx
    bottom = image[rows[1], columns[0]] * (1 - fx) + image[rows[1], columns[1]] * fx
    result: Array = (top * (1 - fy) + bottom * fy).astype(np.float32)
    return result


def _unwrapped(picture: Picture, layout: Layout | None, path: str | PathLike[str]) -> NDArray[Any]:
    """Resample a probe image or a cube map to a lat-long map; leave lat-long maps as they are."""
    image = picture.pixels
    size_y, size_x, _ = image.shape
    cube = picture.cube and layout is None
    if layout == "latlong" or (layout is None and not cube):
        return image
    if cube and (size_y != 6 * size_x or size_x < 2):
        raise FormatError(path, "six faces in a column", f"{size_x} x {size_y} pixels")
    rows = 2 * size_x if cube else max(size_y // 2, 1)
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij"
    )
    w = latlong_to_direction(u, v)
    if cube:
        return _on_faces(image, w)
    across = np.hypot(w[..., 0], w[..., 1])
    safe = np.where(across > 0.0, across, 1.0)
    if layout == "angular":
        r = np.arctan2(across, -w[..., 2]) / math.pi
    else:  # the ball's normal is the half vector of w and +z; its sine is the disc radius
        r = np.sin(0.5 * np.arctan2(across, w[..., 2]))
    x = 0.5 * (1.0 + r * w[..., 0] / safe) * size_x - 0.5
    y = 0.5 * (1.0 - r * w[..., 1] / safe) * size_y - 0.5
    return _bilinear(image, x, y, wrap=False)


def _on_faces(image: NDArray[np.float32], w: Array) -> NDArray[Any]:
    """Look directions (..., 3) up in a cube map (6 n, n, 3), bilinearly within a face.

    Faces and their orientation are those of OpenEXR's ImfEnvmap.h. Its lat-long maps have +z in the
    middle and +x to the left, ours -z and +x to the right: it is turned by 180 degrees.
    """
    size = image.shape[1]
    d = np.stack([-w[..., 0], w[..., 1], -w[..., 2]], axis=-1)
    axis = np.argmax(np.abs(d), axis=-1)  # the first of equal ones, as in OpenEXR
    most = np.take_along_axis(d, axis[..., None], axis=-1)[..., 0]
    # centres of border pixels lie on the cube's edges
    place = (d / np.abs(most)[..., None] + 1.0) * 0.5 * (size - 1)
    across, down = np.empty(axis.shape), np.empty(axis.shape)
    px, py, pz = np.moveaxis(place, -1, 0)
    back = size - 1
    for face, (i, j) in enumerate((
        (pz, back - py), (back - pz, back - py),
        (px, back - pz), (px, pz),
        (back - px, back - py), (px, back - py),
    )):  # fmt: skip
        own = (axis == face // 2) & ((most > 0.0) == (face % 2 == 0))
        across[own], down[own] = i[own], j[own]
    faces = image.reshape(6, size, size, 3)
    result = np.zeros((*axis.shape, 3), np.float32)
    for face in range(6):
        own = (axis == face // 2) & ((most > 0.0) == (face % 2 == 0))
        result[own] = _bilinear(faces[face], across[own], down[own], wrap=False)
    return result
