"""The camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.scene.shapes import Shape

Float64 = NDArray[np.float64]
MAX_SIDE = 16384
MAX_SUBSAMPLES = 256


@dataclass(frozen=True)
class Camera:
    """A perspective camera that orbits a target.

    Parameters
    ----------
    azimuth, elevation : float
        Position of the camera seen from the target, in degrees: 0, 0 is on +z, looking along -z
        with y up; azimuth 90 is on +x. Elevation is in [-90, 90]; 90 is above.
    fov : float
        Vertical field of view in degrees, in (0, 170).
    zoom : float
        Positive. 1 fits the shape's bounding sphere into the frame; 2 moves so close that half of
        it fits.
    target : (3,) world position or None
        The point that the camera looks at; None is the centre of the shape's bounding sphere.

    Raises
    ------
    ValueError
        On numbers that are out of range or not finite.
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    fov: float = 30.0
    zoom: float = 1.0
    target: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("azimuth", "elevation", "fov", "zoom"):
            value = getattr(self, name)
            number = isinstance(value, (int, float, np.integer, np.floating))
            if not (number and math.isfinite(value)):
                raise ValueError(f"{name}: expected a finite number, got {value!r}")
            object.__setattr__(self, name, float(value))
        if not -90.0 <= self.elevation <= 90.0:
            raise ValueError(f"elevation: expected -90 to 90 degrees, got {self.elevation!r}")
        if not 0.0 < self.fov < 170.0:
            raise ValueError(f"fov: expected an angle in (0, 170) degrees, got {self.fov!r}")
        if self.zoom <= 0.0:
            raise ValueError(f"zoom: expected a positive factor, got {self.zoom!r}")
        if self.target is not None:
            target = np.asarray(self.target, np.float64)
            if target.shape != (3,) or not np.isfinite(target).all():
                raise ValueError(f"target: expected three finite numbers, got {self.target!r}")
            object.__setattr__(self, "target", tuple(float(c) for c in target))

    @classmethod
    def orbit(cls, azimuth: float, elevation: float, **settings: Any) -> Camera:
        """Return a camera at the given angles.

        Parameters
        ----------
        azimuth, elevation : float
            Degrees.
        **settings
            The other parameters of `Camera`, by name.
        """
        return cls(azimuth, elevation, **settings)

    def rays(self, shape: Shape, height: int, width: int) -> tuple[Float64, Float64]:
        """Return the origin (3,) and unit directions (height, width, 3) of the pixels' rays.

        Parameters
        ----------
        shape : Shape
            The shape that the camera looks at.
        height, width : int
            Pixels.
        """
        x = np.arange(width, dtype=np.float64) + 0.5
        y = np.arange(height, dtype=np.float64) + 0.5
        return self.position(shape, height, width), self.through(height, width, x, y[:, None])

    def position(self, shape: Shape, height: int, width: int) -> Float64:
        """Return the camera's world position (3,).

        Parameters
        ----------
        shape : Shape
            The shape that the camera looks at.
        height, width : int
            Pixels.
        """
        # the bounding sphere has to fit into the narrower side
        narrow = math.atan(self._slope * min(1.0, width / height))
        distance = shape.radius / math.sin(narrow) / self.zoom
        target = shape.center if self.target is None else np.asarray(self.target)
        position: Float64 = target + distance * self._back
        return position

    def through(self, height: int, width: int, x: Float64, y: Float64) -> Float64:
        """Return unit directions (..., 3) of the rays through image positions.

        Parameters
        ----------
        height, width : int
            Pixels of the image.
        x, y : (...) arrays
            Positions in pixels from the top left corner; they broadcast.
        """
        right, up = self._across
        pixel = 2.0 * self._slope / height
        across, upwards = (x - width / 2) * pixel, (height / 2 - y) * pixel
        ray: Float64 = across[..., None] * right + upwards[..., None] * up - self._back
        ray /= np.sqrt(dots(ray, ray))[..., None]
        return ray

    def project(self, shape: Shape, height: int, width: int, points: Float64) -> Float64:
        """Return the image positions (..., 2) of world points: x, y as `through` takes them.

        Parameters
        ----------
        shape : Shape
            The shape that the camera looks at.
        height, width : int
            Pixels of the image.
        points : (..., 3) array
            Points behind the camera have no position: theirs are NaN.
        """
        right, up = self._across
        offset = points - self.position(shape, height, width)
        depth = -(offset @ self._back)
        scale = height / (2.0 * self._slope) / np.where(depth > 0.0, depth, np.nan)
        x = width / 2 + (offset @ right) * scale
        position: Float64 = np.stack([x, height / 2 - (offset @ up) * scale], axis=-1)
        return position

    @property
    def _slope(self) -> float:
        """Tangent of half the vertical field of view."""
        return math.tan(math.radians(self.fov) / 2)

    @property
    def _across(self) -> tuple[Float64, Float64]:
        """Unit directions (3,) to the right and upwards in the image."""
        a = math.radians(self.azimuth)
        right = np.array([math.cos(a), 0.0, -math.sin(a)])
        return right, np.cross(self._back, right)

    @property
    def _back(self) -> Float64:
        """Unit direction (3,) from the target to the camera."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        return np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])


def dots(a: Float64, b: Float64) -> Float64:
    """Return the dot products (...) of vectors `a` and `b`, both (..., n)."""
    product: Float64 = np.einsum("...k,...k->...", a, b)
    return product


def image_size(size: int | tuple[int, int]) -> tuple[int, int]:
    """Return (height, width) of `size`, which is that pair or one number for both.

    Raises
    ------
    ValueError
        Unless they are whole numbers from 1 to `MAX_SIDE`.
    """
    pair = tuple(size) if isinstance(size, (tuple, list, np.ndarray)) else (size, size)
    if len(pair) != 2 or not all(
        isinstance(s, (int, np.integer)) and not isinstance(s, bool) and 1 <= s <= MAX_SIDE
        for s in pair
    ):
        raise ValueError(
            f"size: expected a whole number of pixels from 1 to {MAX_SIDE}, or (height, width), "
            f"got {size!r}"
        )
    return int(pair[0]), int(pair[1])
