"""A scene: one shape, one camera, and the light. Its product is the list of pixels to shade.

Images have row 0 at the top; a pixel (x, y) counts columns from the left and rows from the top,
with centres at +0.5. One primary ray is shot through each pixel's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.lights import DirectionalLight, EnvironmentMap, Light, PointLight
from traitbrdf.shapes import Shape

Float64 = NDArray[np.float64]

MAX_SIDE = 16384


@dataclass(frozen=True)
class Camera:
    """A perspective camera that orbits a target.

    Parameters
    ----------
    azimuth, elevation : degrees
        Where the camera stands, seen from the target: 0, 0 is on +z, looking along -z with y up;
        azimuth 90 is on +x, elevation 90 above.
    fov : degrees, (0, 170)
        Vertical field of view.
    zoom : float
        1 fits the shape's bounding sphere into the frame, 2 comes so near that half of it fits.
    target : (3,) world position or None
        What the camera looks at; None is the centre of the shape's bounding sphere.
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
        """A camera at the given angles in degrees; `settings` are the other parameters."""
        return cls(azimuth, elevation, **settings)

    def rays(self, shape: Shape, height: int, width: int) -> tuple[Float64, Float64]:
        """Origin (3,) and unit directions (height, width, 3) of the rays through all pixels."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        back = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
        right = np.array([math.cos(a), 0.0, -math.sin(a)])
        up = np.cross(back, right)
        half = math.tan(math.radians(self.fov) / 2)
        # the bounding sphere has to fit into the narrower side
        narrow = math.atan(half * min(1.0, width / height))
        distance = shape.radius / math.sin(narrow) / self.zoom
        target = shape.center if self.target is None else np.asarray(self.target)
        x = (np.arange(width) + 0.5 - width / 2) * (2.0 * half / height)
        y = (height / 2 - np.arange(height) - 0.5) * (2.0 * half / height)
        ray = x[None, :, None] * right + y[:, None, None] * up - back
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        return target + distance * back, ray


class Scene:
    """A shape under light, seen by a camera.

    Parameters
    ----------
    shape : what is looked at
    environment : EnvironmentMap or None
        None is `EnvironmentMap.sky()`.
    lights : point and directional lights beside the map
    camera : Camera
    size : int or (height, width)
        Pixels, 1 to 16384 on a side.

    Attributes
    ----------
    parts : tuple of str
    pixels : (P,) int64, flat indices of the covered pixels, part by part, ascending in each
    pixel_part : (P,) int32, index of the part seen
    normals, views, positions : (P, 3) float64
        World unit normals facing the viewer, unit directions towards the viewer, positions.

    Raises
    ------
    ValueError, TypeError
        On a size that is not positive, or lights that are none.
    """

    def __init__(
        self,
        shape: Shape,
        environment: EnvironmentMap | None = None,
        lights: Sequence[Light] = (),
        camera: Camera | None = None,
        size: int | tuple[int, int] = 512,
    ) -> None:
        if not callable(getattr(shape, "intersect", None)):
            raise TypeError(f"shape: expected a shape such as teapot(), got {shape!r}")
        if environment is not None and not isinstance(environment, EnvironmentMap):
            raise TypeError(f"environment: expected an EnvironmentMap, got {environment!r}")
        for light in lights:
            if not isinstance(light, (PointLight, DirectionalLight)):
                raise TypeError(f"lights: expected point or directional lights, got {light!r}")
        if camera is not None and not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a Camera, got {camera!r}")
        self.height, self.width = _image_size(size)
        self.shape = shape
        self.environment = EnvironmentMap.sky() if environment is None else environment
        self.lights = tuple(lights)
        self.camera = Camera.orbit(35.0, 20.0) if camera is None else camera
        self.parts = tuple(shape.parts)
        origin, rays = self.camera.rays(shape, self.height, self.width)
        flat = rays.reshape(-1, 3)
        hits = shape.intersect(np.broadcast_to(origin, flat.shape), flat)
        covered = np.flatnonzero(hits.part >= 0)
        # part by part, so that a part's pixels are one slice
        self.pixels = covered[np.argsort(hits.part[covered], kind="stable")]
        self.pixel_part = hits.part[self.pixels]
        self.normals = hits.normal[self.pixels]
        self.positions = hits.position[self.pixels]
        self.views = -flat[self.pixels]
        self.part_image = hits.part.reshape(self.height, self.width)
        self._rays = rays

    def __repr__(self) -> str:
        return (
            f"Scene({self.width}x{self.height}, {len(self.pixels)} covered pixels, "
            f"parts={list(self.parts)})"
        )

    @property
    def coverage(self) -> float:
        """Fraction of the frame that the shape covers."""
        return len(self.pixels) / (self.height * self.width)

    def part_slice(self, part: int) -> slice:
        """Where in `pixels` the pixels of one part lie."""
        return slice(
            int(np.searchsorted(self.pixel_part, part, "left")),
            int(np.searchsorted(self.pixel_part, part, "right")),
        )

    def backdrop(self) -> NDArray[np.float32]:
        """The frame (height, width, 3) without the object: the map seen through the camera."""
        return np.asarray(self.environment.backdrop(self._rays), np.float32)


def _image_size(size: int | tuple[int, int]) -> tuple[int, int]:
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
