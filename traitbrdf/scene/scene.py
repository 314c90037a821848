"""A scene: a shape under lights, seen by a camera and split into fragments of its image."""

from __future__ import annotations

import copy
import inspect
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from traitbrdf.arguments import told
from traitbrdf.host import steady
from traitbrdf.scene.camera import MAX_SUBSAMPLES, Camera, dots, image_size
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, Light, PointLight
from traitbrdf.scene.shapes import Hits, Shape

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

GROUND = "ground"
"""Name of the part that `Scene(..., ground=True)` adds."""

_GROUND_RADIUS = 2.0  # default, in radii of the shape
RAYS_AT_ONCE = 1 << 16
"""Rays in one call, which takes some 15 ms; several calls run in parallel."""

_FEW_RAYS = 1 << 12  # so few are not worth a thread

_CREASE = math.cos(math.radians(40.0))  # a border lies between normals that differ by more
_JUMP = 3.0  # pixels; a border lies between pixels further off each other's plane
_LIGHT_MARGIN = 1e-5  # relative distance to a point light below which nothing hides it
_SEEN = (
    "part_image", "uncovered", "pixels", "pixel_part", "weights", "bordering", "offsets",
    "normals", "views", "positions", "starts", "_sample_part", "_bounds",
)  # fmt: skip


@steady
class Scene:
    """A shape under light, seen by a camera.

    Shading works on *fragments*: a fragment is one part within one pixel. It is sampled once, at
    the centre of the pixel. If the pixel is at a border of parts, a silhouette or a crease, the
    fragment has one sample for each of the `subsamples` rays that hit the part.

    The ground receives the shape's shadows, but it hides nothing of the map from the shape: the
    lower half of a captured map already *is* the light of the floor, and hiding it would leave
    undersides black. Point and directional lights beneath the ground do not shine through it.

    Parameters
    ----------
    shape : Shape
        The shape to look at, such as `sphere()`, `teapot()` or a mesh.
    environment : EnvironmentMap or None
        None is `EnvironmentMap.sky()`.
    lights : sequence of PointLight and DirectionalLight
        Lights in addition to the map.
    camera : Camera or None
        None is `Camera.orbit(35, 20)`. The ground does not change the framing.
    size : int or (height, width)
        Pixels, 1 to 16384 on a side.
    ground : bool or float
        Whether a horizontal disc, the part "ground", lies under the shape's lowest point. A
        number is its radius in radii of the shape; True is 2. It is invisible from below.
    shadows : bool
        Whether the shape hides light from itself and from the ground, and the ground from the
        shape.
    subsamples : int
        Rays through a pixel at a border, 1 to 256; 1 turns antialiasing off.

    Attributes
    ----------
    parts : tuple of str
        The shape's parts, and "ground" if there is one.
    ground : False or float
        The ground's radius in radii of the shape.
    casts : tuple of bool
        For each part, whether shadow rays are needed.
    rays_cast : int
        Shadow rays cast so far.
    part_image : (height, width) int32
        Index of the part at each pixel's centre; -1 for none.
    uncovered : (height * width,) float32
        Share of each pixel that shows the backdrop: 1 minus the weights of its fragments.
    pixels : (P,) int64
        Flat pixel index of each fragment, part by part, ascending in each.
    pixel_part : (P,) int32
        Index of the part of each fragment.
    weights : (P,) float64
        Share of its pixel that each fragment covers, above 0, at most 1.
    bordering : (P,) bool
        Whether the fragment lies in a pixel at a border.
    offsets : (P + 1,) int64
        The samples of fragment f are `offsets[f]` to `offsets[f + 1]`, with equal weights.
    normals, views, positions, starts : (N, 3) float64
        For each sample: the world unit normal facing the viewer, the unit direction towards the
        viewer, the position, and the start of shadow rays.

    Raises
    ------
    TypeError
        On a shape, camera, map or light of another type.
    ValueError
        On a size, ground radius or number of subsamples out of range, or if the shape has a part
        named "ground" of its own.
    """

    part_image: Int32
    uncovered: NDArray[np.float32]
    pixels: Int64
    pixel_part: Int32
    weights: Float64
    bordering: Bool
    offsets: Int64
    normals: Float64
    views: Float64
    positions: Float64
    starts: Float64
    _sample_part: Int32
    _bounds: list[int]

    def __init__(
        self,
        shape: Shape,
        environment: EnvironmentMap | None = None,
        lights: Sequence[Light] = (),
        camera: Camera | None = None,
        size: int | tuple[int, int] = 512,
        ground: bool | float = False,
        shadows: bool = True,
        subsamples: int = 8,
    ) -> None:
        if not callable(getattr(shape, "intersect", None)):
            given: object = shape
            hint = ": tb.load_mesh reads a file" if isinstance(given, str) else ""
            raise TypeError(f"shape: expected a shape such as teapot(), got {told(shape)}{hint}")
        if camera is not None and not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a Camera, got {camera!r}")
        if (
            not isinstance(subsamples, (int, np.integer))
            or isinstance(subsamples, bool)
            or not 1 <= subsamples <= MAX_SUBSAMPLES
        ):
            raise ValueError(
                f"subsamples: expected a whole number from 1 to {MAX_SUBSAMPLES}, "
                f"got {subsamples!r}"
            )
        self.height, self.width = image_size(size)
        self.shape = shape
        self.camera = Camera.orbit(35.0, 20.0) if camera is None else camera
        self.ground = _ground_radius(ground)
        self.subsamples = int(subsamples)
        self.parts = tuple(shape.parts)
        if self.ground:
            if GROUND in self.parts:
                raise ValueError(f"ground: expected a shape without a part {GROUND!r}, got one")
            self.parts = (*self.parts, GROUND)
        self._light(environment, lights, shadows)

    def __getattr__(self, name: str) -> Any:
        # primary rays are cast when their hits are first needed: a draft renders a smaller copy
        # of the scene and needs none of them
        if name in _SEEN:
            self._see()
            return self.__dict__[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _light(
        self, environment: EnvironmentMap | None, lights: Sequence[Light], shadows: bool
    ) -> None:
        """Set the settings that the primary rays do not depend on."""
        if environment is not None and not isinstance(environment, EnvironmentMap):
            raise TypeError(
                f"environment: expected an EnvironmentMap, got {told(environment)}; "
                "tb.EnvironmentMap.read reads a file"
            )
        many: object = lights
        if not isinstance(many, Sequence):
            raise TypeError(f"lights: expected a sequence of lights, got {told(many)}")
        for light in lights:
            if not isinstance(light, (PointLight, DirectionalLight)):
                raise TypeError(f"lights: expected point or directional lights, got {light!r}")
        if not isinstance(shadows, (bool, np.bool_)):
            raise TypeError(f"shadows: expected True or False, got {shadows!r}")
        self.environment = EnvironmentMap.sky() if environment is None else environment
        self.lights = tuple(lights)
        self.shadows = bool(shadows)
        self.rays_cast = 0
        # to a camera inside it, even a convex shape hides the world
        stands = self.camera.position(self.shape, self.height, self.width)
        outside = math.dist(stands, self.shape.center) > self.shape.radius
        hides = self.shadows and not (outside and self.shape.convex)
        own = (hides,) * len(self.shape.parts)
        self.casts: tuple[bool, ...] = (*own, self.shadows) if self.ground else own

    def __repr__(self) -> str:
        return (
            f"Scene({self.width}x{self.height}, {np.count_nonzero(self.uncovered < 1.0)} covered "
            f"pixels, {len(self.normals)} samples, parts={list(self.parts)})"
        )

    @property
    def coverage(self) -> float:
        """Fraction of the frame that the shape covers, without the ground."""
        own = slice(0, self.part_slice(len(self.shape.parts) - 1).stop)
        return float(self.weights[own].sum()) / (self.height * self.width)

    def part_slice(self, part: int) -> slice:
        """Return the slice of `pixels` that holds the fragments of part index `part`."""
        return slice(self._bounds[part], self._bounds[part + 1])

    def samples(self, index: NDArray[np.integer]) -> tuple[Int64, Int64, Float64]:
        """Return the samples of fragments, one fragment after the other.

        Parameters
        ----------
        index : (m,) int array
            Fragments.

        Returns
        -------
        sample : (n,) int64 array
            Index of each sample.
        owner : (n,) int64 array
            Which of the m fragments it belongs to, 0 to m - 1.
        share : (n,) float64 array
            Share of the pixel that it represents; the shares of a fragment sum to its weight.
        """
        first = self.offsets[:-1][index]
        count = self.offsets[1:][index] - first
        owner = np.repeat(np.arange(len(count)), count)
        ahead = np.cumsum(count) - count
        sample = np.arange(len(owner)) + (first - ahead)[owner]
        return sample, owner, (self.weights[index] / count)[owner]

    def changed(self, **settings: Any) -> Scene:
        """Return a scene of the same shape with some settings changed.

        If only the light changes (environment, lights, shadows), no primary rays are cast again.

        Parameters
        ----------
        **settings
            Parameters of the constructor, by name; the others stay.

        Raises
        ------
        TypeError
            On a name that is no setting, or as the constructor does.
        ValueError
            As the constructor does.
        """
        names = [*inspect.signature(Scene).parameters][1:]
        unknown = sorted(settings.keys() - set(names))
        if unknown:
            raise TypeError(f"expected settings among {names}, got {unknown}")
        kept: dict[str, Any] = {name: getattr(self, name) for name in names if name != "size"}
        chosen = {**kept, "size": (self.height, self.width), **settings}
        light = ("environment", "lights", "shadows")
        if settings.keys() <= set(light):
            result = copy.copy(self)
            result._light(*(chosen[name] for name in light))
            return result
        return Scene(self.shape, **chosen)

    def backdrop(self) -> NDArray[np.float32]:
        """Return the frame (height, width, 3) without the object: the map behind it."""
        behind = np.empty((self.height, self.width, 3), np.float32)
        x = np.arange(self.width, dtype=np.float64) + 0.5
        band = max(1, RAYS_AT_ONCE // self.width)
        for first in range(0, self.height, band):
            rows = slice(first, min(first + band, self.height))
            y = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None] + 0.5
            rays = self.camera.through(self.height, self.width, x, np.asarray(y, np.float64))
            behind[rows] = self.environment.backdrop(rays)
        return behind

    # -- light that reaches a sample ------------------------------------------------------------

    def visible(
        self,
        index: NDArray[np.integer],
        directions: NDArray[np.floating[Any]],
        starts: Float64 | None = None,
    ) -> Bool:
        """Return whether light from infinitely far away reaches samples, as booleans (m,).

        Directions below the surface may count as visible for parts that need no rays (`casts`),
        because the cosine term removes them.

        Parameters
        ----------
        index : (m,) int array
            Samples.
        directions : (m, 3) array
            Unit vectors towards the light.
        starts : (m, 3) array or None
            Where rays start, as `spread` returns them; None for the samples' own starts.

        Raises
        ------
        ValueError
            If shapes do not fit, or directions that need rays are not of unit length.
        """
        index = np.asarray(index)
        directions = np.asarray(directions)
        if directions.shape != (*index.shape, 3):
            raise ValueError(
                f"directions: expected shape {(*index.shape, 3)}, got {directions.shape}"
            )
        free = np.ones(len(index), dtype=bool)
        cast = self._cast_rows(index)

        def shoot(rows: slice) -> None:
            chosen = rows if cast is None else cast[rows]
            start = self.starts[index[chosen]] if starts is None else starts[chosen]
            free[chosen] = ~self.shape.occluded(start, directions[chosen])

        count = len(index) if cast is None else len(cast)
        self.rays_cast += count
        _in_parallel(shoot, _chunks(count))
        return free

    def arriving(
        self, light: Light, index: NDArray[np.integer], starts: Float64 | None = None
    ) -> tuple[Float64, Float64]:
        """Return directions to a light and the irradiance on a surface facing it, both (m, 3).

        Irradiance is zero where the light is behind the surface or hidden.

        Parameters
        ----------
        light : PointLight or DirectionalLight
        index : (m,) int array
            Samples.
        starts : (m, 3) array or None
            Where shadow rays start, as `spread` returns them; None for the samples' own starts.
        """
        index = np.asarray(index)
        toward, given = light.arriving(self.positions[index])
        lit = (dots(toward, self.normals[index]) > 0.0) & given.any(axis=-1)
        if self.shadows:
            near = light.position if isinstance(light, PointLight) else None
            if self.ground:
                lit[lit] = ~self._under_ground(self.positions[index[lit]], toward[lit], near)
            rows = np.flatnonzero(lit)
            cast = self._cast_rows(index[rows])
            rows = rows if cast is None else rows[cast]
            for some in _chunks(len(rows)):
                at = rows[some]
                start = self.starts[index[at]] if starts is None else starts[at]
                lit[at] = self._unhidden(start, toward[at], near)
        return toward, np.where(lit[:, None], given, 0.0)

    def spread(self, index: NDArray[np.integer], count: int) -> Float64:
        """Return starts (m, count, 3) of shadow rays, spread over the pixels of samples.

        Where the pixel shows another part, they are that of the sample.

        Parameters
        ----------
        index : (m,) int array
            Samples, each the only one of its fragment.
        count : int
        """
        index = np.asarray(index)
        y, x = np.divmod(self.pixels[np.searchsorted(self.offsets, index, "right") - 1], self.width)
        u, v = sample_pattern(count)
        # another shift in each pixel, or what runs along an axis would meet the same rows in all
        u = (u + (0.7549 * x + 0.5698 * y)[:, None]) % 1.0
        v = (v + (0.5698 * x + 0.7549 * y)[:, None]) % 1.0
        origin = self.camera.position(self.shape, self.height, self.width)
        hits = self._shoot(origin, (x[:, None] + u).ravel(), (y[:, None] + v).ravel())
        own = np.repeat(index, count)
        same = (hits.part == self._sample_part[own])[:, None]
        return np.where(same, hits.start, self.starts[own]).reshape(len(index), count, 3)

    def hits(self, x: Float64, y: Float64) -> Hits:
        """Return what is seen at image positions: the part, -1 for none, its position and normal.

        Parameters
        ----------
        x, y : (n,) float64 arrays
            In pixels from the top left corner.
        """
        return self._shoot(self.camera.position(self.shape, self.height, self.width), x, y)

    def reached(self, points: Float64, directions: Float64) -> Float64:
        """Return where rays first meet the shape or the ground: (n, 3), NaN where they do not.

        Parameters
        ----------
        points, directions : (n, 3) float64 arrays
            Starts, and unit vectors.
        """
        found = np.full(points.shape, np.nan)

        def shoot(rows: slice) -> None:
            hits = self.shape.intersect(points[rows], directions[rows])
            met = hits.part >= 0
            found[rows][met] = hits.position[met]

        _in_parallel(shoot, _chunks(len(points)))
        if self.ground:
            free = np.flatnonzero(np.isnan(found[:, 0]) & (directions[:, 1] < 0.0))
            free = free[self._over_ground(points[free], directions[free])]
            away = (self.shape.lowest - points[free, 1:2]) / directions[free, 1:2]
            found[free] = points[free] + away * directions[free]
        return found

    def _cast_rows(self, index: NDArray[np.integer]) -> Int64 | None:
        """Return which of samples (m,) need rays; None for all of them."""
        if all(self.casts):
            return None
        if not any(self.casts):
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(np.asarray(self.casts)[self._sample_part[index]])

    def _unhidden(
        self, starts: Float64, toward: Float64, near: tuple[float, float, float] | None
    ) -> Bool:
        """Return whether light reaches starts (n, 3) past the shape, in one chunk of rays."""
        self.rays_cast += len(starts)
        if near is None:
            return ~self.shape.occluded(starts, toward)
        # the ray starts off the surface, so its direction to the light differs
        offset = np.asarray(near) - starts
        largest = np.abs(offset).max(axis=-1, keepdims=True)
        scaled = offset / np.where(largest == 0.0, 1.0, largest)  # so that squares cannot overflow
        length = np.sqrt(dots(scaled, scaled))
        at_light = length == 0.0
        direction = scaled / np.where(at_light, 1.0, length)[:, None]
        direction = np.where(at_light[:, None], toward, direction)
        distance = length * largest[:, 0] * (1.0 - _LIGHT_MARGIN)
        return ~self.shape.occluded(starts, direction, distance)

    def _under_ground(
        self, points: Float64, toward: Float64, near: tuple[float, float, float] | None
    ) -> Bool:
        """Return whether the ground is between points (n, 3) above it and a light."""
        down = toward[:, 1] < 0.0
        if near is not None:
            down &= near[1] < self.shape.lowest
        hidden: Bool = down & self._over_ground(points, toward)
        return hidden

    def _over_ground(self, points: Float64, rays: Float64) -> Bool:
        """Return whether downward rays (n, 3) from points (n, 3) above the ground meet its disc."""
        # multiplied by the ray's slope, to avoid a division by a slope near zero
        slope = np.abs(rays[:, 1:2])
        height = points[..., 1:2] - self.shape.lowest
        across = (points - self.shape.center) * slope + height * rays
        inside: Bool = np.hypot(across[:, 0], across[:, 2]) <= (
            self.ground * self.shape.radius * slope[:, 0]
        )
        return inside

    # -- primary rays ---------------------------------------------------------------------------

    def _see(self) -> None:
        """Cast the primary rays and sort their hits into fragments."""
        size = self.height * self.width
        y, x = np.divmod(np.arange(size), self.width)
        origin = self.camera.position(self.shape, self.height, self.width)
        hits = self._shoot(origin, x + 0.5, y + 0.5)
        border = np.zeros(size, dtype=bool)
        if self.subsamples > 1:
            border = self._borders(origin, hits)
        inner = np.flatnonzero((hits.part >= 0) & ~border)
        at_border = np.flatnonzero(border)
        u, v = sample_pattern(self.subsamples)
        fine_x = (x[at_border, None] + u).ravel()
        fine_y = (y[at_border, None] + v).ravel()
        fine = self._shoot(origin, fine_x, fine_y)
        met = np.flatnonzero(fine.part >= 0)

        pixel = np.concatenate([inner, np.repeat(at_border, self.subsamples)[met]])
        part = np.concatenate([hits.part[inner], fine.part[met]])
        # sorted by part, so that the fragments of a part are one slice
        order = np.argsort(part.astype(np.int64) * size + pixel, kind="stable")
        pixel, part = pixel[order], part[order]

        def gathered(name: str) -> Float64:
            both = [getattr(hits, name)[inner], getattr(fine, name)[met]]
            return np.concatenate(both)[order]

        toward = self.camera.through(
            self.height,
            self.width,
            np.concatenate([x[inner] + 0.5, fine_x[met]])[order],
            np.concatenate([y[inner] + 0.5, fine_y[met]])[order],
        )
        new = np.ones(len(pixel) + 1, dtype=bool)
        new[1:-1] = (pixel[1:] != pixel[:-1]) | (part[1:] != part[:-1])
        new[-1] = True
        offsets = np.flatnonzero(new) if len(pixel) else np.zeros(1, dtype=np.int64)
        first, count = offsets[:-1], np.diff(offsets)
        bordering = border[pixel[first]]
        missed = (hits.part < 0).astype(np.float32)
        missed[at_border] = np.mean(fine.part.reshape(-1, self.subsamples) < 0, axis=1)
        # in one step, because another thread may read them
        self.__dict__.update(
            part_image=hits.part.reshape(self.height, self.width),
            normals=gathered("normal"), positions=gathered("position"), starts=gathered("start"),
            views=-toward, _sample_part=part, offsets=offsets, pixels=pixel[first],
            pixel_part=part[first], bordering=bordering,
            weights=np.where(bordering, count / self.subsamples, 1.0), uncovered=missed,
            _bounds=np.searchsorted(part[first], np.arange(len(self.parts) + 1)).tolist(),
        )  # fmt: skip

    def _shoot(self, origin: Float64, x: Float64, y: Float64) -> Hits:
        """Return the hits of rays from the camera at `origin` through image positions x, y (n,)."""
        count = len(x)
        hits = Hits(
            np.full(count, -1, dtype=np.int32),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
        )

        def shoot(rows: slice) -> None:
            rays = self.camera.through(self.height, self.width, x[rows], y[rows])
            found = self.shape.intersect(origin, rays)
            hits.part[rows] = found.part
            hits.position[rows] = found.position
            hits.normal[rows] = found.normal
            hits.start[rows] = found.start
            if self.ground:
                self._shoot_ground(origin, rays, rows, hits)

        _in_parallel(shoot, _chunks(count))
        return hits

    def _shoot_ground(self, origin: Float64, rays: Float64, rows: slice, hits: Hits) -> None:
        """Add the ground to `hits[rows]`; from above, it is behind all of the shape."""
        lowest = self.shape.lowest
        if origin[1] <= lowest:
            return
        free = np.flatnonzero((hits.part[rows] < 0) & (rays[:, 1] < 0.0))
        free = free[self._over_ground(origin, rays[free])]
        away = (lowest - origin[1]) / rays[free, 1:2]
        position = origin + away * rays[free]
        position[:, 1] = lowest
        at = rows.start + free
        hits.part[at] = len(self.parts) - 1
        hits.normal[at] = (0.0, 1.0, 0.0)
        hits.position[at] = position
        hits.start[at] = position  # the ground is no part of the mesh, so no offset is needed

    def _borders(self, origin: Float64, hits: Hits) -> Bool:
        """Return the mask (height * width,) of pixels with a border in their 3 x 3 neighbourhood.

        At a border the part changes, the surface bends sharply, or its depth jumps.
        """
        frame = (self.height, self.width)
        part = hits.part.reshape(frame)
        normal = hits.normal.reshape(*frame, 3)
        position = hits.position.reshape(*frame, 3)
        offset = hits.position - origin
        pixel = 2.0 * math.tan(math.radians(self.camera.fov) / 2) / self.height
        reach = (_JUMP * pixel * np.sqrt(dots(offset, offset))).reshape(frame)
        border = np.zeros(frame, dtype=bool)
        every, later, sooner = slice(None), slice(1, None), slice(None, -1)
        for a, b in (
            ((every, sooner), (every, later)),
            ((sooner, every), (later, every)),
            ((sooner, sooner), (later, later)),
            ((sooner, later), (later, sooner)),
        ):
            apart = position[b] - position[a]
            ends = part[a] != part[b]
            ends |= (part[a] >= 0) & (dots(normal[a], normal[b]) < _CREASE)
            off = np.maximum(np.abs(dots(apart, normal[a])), np.abs(dots(apart, normal[b])))
            ends |= off > np.maximum(reach[a], reach[b])
            border[a] |= ends
            border[b] |= ends
        return border.ravel()


def _threads() -> int:
    """Return how many threads cast rays: one a core, unless OMP_NUM_THREADS says less."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    said = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores or 1, int(said) if said.isdecimal() and int(said) > 0 else 1 << 10)


def _in_parallel(work: Callable[[slice], None], chunks: list[slice]) -> None:
    """Work on all chunks; the tracer lets other threads run meanwhile."""
    threads = min(_threads(), len(chunks))
    if threads <= 1:
        for rows in chunks:
            work(rows)
        return
    with ThreadPoolExecutor(threads, "traitbrdf-rays") as pool:
        for _ in pool.map(work, chunks):  # raises what one of them raised
            pass


def _chunks(count: int) -> list[slice]:
    """Return slices that divide `count` rays among threads, at most `RAYS_AT_ONCE` in each."""
    size = min(RAYS_AT_ONCE, max(_FEW_RAYS, -(-count // _threads())))
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]


def sample_pattern(count: int) -> tuple[Float64, Float64]:
    """Return positions x, y (count,) in the unit square, one in each of `count` rows and columns.

    So edges along the axes are antialiased in equal steps. The golden ratio orders the rows, which
    spreads the positions well.
    """
    step = np.arange(count)
    golden = (step * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
    return (step + 0.5) / count, (np.argsort(np.argsort(golden)) + 0.5) / count


def _ground_radius(ground: bool | float) -> float | Literal[False]:
    """Return the radius of the ground in radii of the shape; False for none."""
    if isinstance(ground, (bool, np.bool_)):
        return _GROUND_RADIUS if ground else False
    number = isinstance(ground, (int, float, np.integer, np.floating))
    if not (number and math.isfinite(ground) and ground > 0.0):
        raise ValueError(
            f"ground: expected True, False or a radius above 0 in radii of the shape, "
            f"got {ground!r}"
        )
    return float(ground)
