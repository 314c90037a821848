"""The reference: brute-force integration of the reflection equation in float64.

I(x, wo) = integral of L(wi) V(x, wi) rho(wi, wo) max(0, wi.n) d omega over the texels of the map,
in which radiance is constant, plus the lights beside it. The method is slow and simple on purpose.
Every texel above the horizon is visited. Texels are cut until they are small compared with their
distance from the mirror peak and from the horizon, and the whole mesh is refined until two
successive results agree. It shares no quadrature with `traitbrdf.transport`.

Shadows are defined so that there is one result to converge to. Each texel is divided into n x n
pieces equal in both angles, with the least n for which none is taller than `SHADOW_CELL`. A piece
is visible or hidden as a whole, which one ray towards the centroid of its solid angle decides. So
the visible light at one point is again piecewise constant, and the stated errors are those of its
integral. They do not include the error of the pieces themselves: the edge of a shadow passes
through them. The penumbra of a light k pieces wide has about k steps where that edge is parallel to
their sides, and many more where it is not. The mirror's delta term sends one ray in its own
direction; a point or directional light sends one ray to the light.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.arguments import told
from traitbrdf.directions import half_diff_angles, reflect, to_local
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.host import steady_in_threads
from traitbrdf.reflectance.brdf import HalfDiffGrid, Reflectance, TabulatedBRDF, checked_reflectance
from traitbrdf.scene.lights import EnvironmentMap, Light, PointLight, texel_moments, turn_about_y
from traitbrdf.scene.scene import Scene

Float64 = NDArray[np.float64]
Index = NDArray[np.int64]
Visible: TypeAlias = Callable[[Index, Float64], NDArray[np.bool_]]
"""Tells whether light from infinity reaches points (m,) from world directions (m, 3): (m,) bool."""
Arriving: TypeAlias = tuple[Float64, Float64]
"""Light at n points: world directions to it, and irradiance perpendicular to them, (n, 3) each."""

SHADOW_CELL = 0.0125
"""Greatest height in radians of a piece of the map that is visible or hidden as a whole."""

MAX_CELLS = 1_000_000
"""Most cells of one mesh; a point that needs more is refused."""

_COARSEST = 0.2  # resolution of the first mesh; see `integrate`
_CHUNK = 1 << 17  # directions that are evaluated at a time
_BLOCK = 256  # samples that are integrated at a time
_GAUSS = 0.5 / math.sqrt(3.0)  # the two Gauss-Legendre points, from the middle, in widths


class Shadows(NamedTuple):
    """What the map's light meets on its way to surface points.

    Attributes
    ----------
    visible : ``visible(point (m,), directions (m, 3)) -> (m,) bool``
        Whether light from infinity reaches points, given by their index, from world directions.
    cell : radians
        Greatest height of a piece of the map that is visible or hidden as a whole; see the head of
        this module.
    """

    visible: Visible
    cell: float = SHADOW_CELL


class IntegrationError(RuntimeError):
    """The tolerance was not reached; the message names the point and the limit."""


@steady_in_threads
def radiance(
    normals: Float64,
    views: Float64,
    brdfs: Sequence[Reflectance],
    environment: EnvironmentMap | None = None,
    lights: Sequence[Light | Arriving] = (),
    positions: Float64 | None = None,
    tolerance: float = 1e-4,
    shadows: Shadows | None = None,
) -> tuple[Float64, Float64]:
    """Compute the radiance that leaves surface points towards the viewer.

    Parameters
    ----------
    normals, views : (n, 3) float64
        World unit vectors; views point towards the viewer and lie above the surface.
    brdfs : B reflectances
        Each point is computed for all of them.
    environment : EnvironmentMap or None
    lights : lights beside the map
        Lights without shadows, or pairs (directions, irradiance) of light as it arrives.
    positions : (n, 3) float64 or None
        World positions; point lights need them.
    tolerance : float
        Greatest estimated error, relative to the largest channel of the point.
    shadows : Shadows or None
        What the map's light meets on its way to the points; None lets all of it pass.

    Returns
    -------
    radiance, error : (n, B, 3)
        The radiance, and an estimate of its absolute error that is the same for the three channels:
        the change by the last refinement, but at least 0.3 times the tolerance. It is no bound. It
        contained the true error in 99.7 % of 3,000 random cases at tolerances of 1e-2 to 1e-4. The
        only cases that it missed by more than a factor of 3 were radiances below 1e-26, far out in
        the tail of a sharp lobe.

    Raises
    ------
    IntegrationError
        If the estimate stays above the tolerance.
    ValueError
        If point lights come without positions, or the shadows' cell is not above 0.
    """
    if shadows is not None:
        _check_cell(shadows.cell)
    visible = None if shadows is None else shadows.visible
    count = len(normals)
    if positions is None:
        if any(isinstance(light, PointLight) for light in lights):
            raise ValueError("positions: point lights need the (n, 3) positions of the points")
        positions = np.zeros((count, 3))
    result = np.zeros((count, len(brdfs), 3))
    error = np.zeros_like(result)
    evaluate = Evaluator(brdfs)
    if environment is not None:
        result += _mirrored(normals, views, brdfs, environment, visible)
        texels = Cells.texels(environment.image)
        pieces = None if shadows is None else Pieces(environment, shadows.cell)
        for p in range(count):
            cells = texels
            if pieces is not None and visible is not None:
                cells = pieces.seen(p, normals[p], visible)
            n = np.asarray(environment.to_map(normals[p]), np.float64)
            v = np.asarray(environment.to_map(views[p]), np.float64)
            values, error[p] = _converge(cells, n, v, evaluate, tolerance, p)
            result[p] += values
    for light in lights:
        toward, irradiance = light if isinstance(light, tuple) else light.arriving(positions)
        for p in range(count):
            wi, wo = np.asarray(to_local(np.stack([toward[p], views[p]]), normals[p]), np.float64)
            result[p] += evaluate(wi[None], wo, irradiance[p : p + 1] * max(wi[2], 0.0))
    return result, error


@steady_in_threads
def fragments(
    scene: Scene,
    index: ArrayLike,
    brdfs: Sequence[Reflectance],
    tolerance: float = 1e-4,
    shadow_cell: float = SHADOW_CELL,
) -> tuple[Float64, Float64]:
    """Compute what fragments of a scene add to their pixels, under all its light and shadows.

    The result is the sum over a fragment's samples of their radiance times their share of the
    pixel: a fragment that covers a tenth of its pixel adds a tenth of its radiance.

    Parameters
    ----------
    scene : Scene
    index : (m,) array_like of int
        Fragments of the scene.
    brdfs : B reflectances
        Each fragment is computed for all of them.
    tolerance : float
        Greatest estimated error of each sample, relative to its largest channel.
    shadow_cell : float
        In radians; see `Shadows`.

    Returns
    -------
    radiance, error : (m, B, 3)
        As `radiance` returns them; the errors of a fragment's samples add up.

    Raises
    ------
    IntegrationError
        As `radiance` does; its message counts points within one block of samples.
    IndexError
        If there is no such fragment.
    ValueError
        If `shadow_cell` is not above 0.
    """
    _check_cell(shadow_cell)
    chosen = np.asarray(index, np.int64)
    sample, owner, share = scene.samples(chosen)
    result = np.zeros((len(chosen), len(brdfs), 3))
    error = np.zeros_like(result)
    casts = np.array(scene.casts, np.bool_)[scene.pixel_part[chosen]][owner]
    for needs_rays in (False, True):
        rows = np.flatnonzero(casts == needs_rays)
        for start in range(0, len(rows), _BLOCK):
            some = rows[start : start + _BLOCK]
            here = sample[some]

            def visible(point: Index, w: Float64, here: Index = here) -> NDArray[np.bool_]:
                return scene.visible(here[point], w)

            values, errors = radiance(
                scene.normals[here],
                scene.views[here],
                brdfs,
                scene.environment,
                [scene.arriving(light, here) for light in scene.lights],
                tolerance=tolerance,
                shadows=Shadows(visible, shadow_cell) if needs_rays else None,
            )
            weight = share[some, None, None]
            np.add.at(result, owner[some], weight * values)
            np.add.at(error, owner[some], weight * errors)
    return result, error


@steady_in_threads
def render(
    scene: Scene,
    brdfs: Reflectance | Mapping[str, Reflectance],
    tolerance: float = 1e-4,
    progress: Callable[[str, float], None] | None = None,
) -> Float64:
    """Render the whole frame (H, W, 3) float64: linear radiance, backdrop included.

    Parameters
    ----------
    scene : Scene
    brdfs : one reflectance for all parts, or one for each part by name
    tolerance : float
        Greatest estimated error of each sample, relative to its largest channel.
    progress : called with ("reference", fraction done); may raise to cancel

    Raises
    ------
    IntegrationError
        As `radiance` does.
    ValueError
        If a visible part has no reflectance.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a Scene, got {told(scene)}")
    for brdf in brdfs.values() if isinstance(brdfs, Mapping) else [brdfs]:
        checked_reflectance(brdf, "brdfs")
    if isinstance(brdfs, Mapping):
        seen = [scene.parts[i] for i in np.unique(scene.pixel_part)]
        missing = [name for name in seen if name not in brdfs]
        if missing:
            raise ValueError(f"brdfs: expected one for each part seen, got none for {missing}")
    image = scene.backdrop().astype(np.float64)
    flat = image.reshape(-1, 3)
    flat *= scene.uncovered[:, None]
    done = 0
    for part, name in enumerate(scene.parts):
        index = np.flatnonzero(scene.pixel_part == part)
        for some in np.array_split(index, math.ceil(len(index) / 64)) if len(index) else []:
            brdf = brdfs[name] if isinstance(brdfs, Mapping) else brdfs
            values, _ = fragments(scene, some, [brdf], tolerance)
            np.add.at(flat, scene.pixels[some], values[:, 0])
            done += len(some)
            if progress is not None:
                progress("reference", done / len(scene.pixels))
    return image


def relative_error(image: ArrayLike, reference: ArrayLike) -> float:
    """Return the mean relative L1 of linear radiance: mean|I - I_ref| / mean(I_ref).

    Raises
    ------
    ValueError
        If the two shapes differ.
    """
    shown, true = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if shown.shape != true.shape:
        raise ValueError(f"image: expected the reference's shape {true.shape}, got {shown.shape}")
    level = true.mean()
    deviation = np.abs(shown - true).mean()
    return float(deviation / level) if level > 0.0 else float(deviation)


def tone_mapped_psnr(image: ArrayLike, reference: ArrayLike) -> float:
    """Return the PSNR in dB, at most 99, of tone-mapped pictures (..., 3).

    Both are linear radiance, and are shown at the exposure of the reference.
    """
    exposure = exposure_of(reference)
    shown = tone_map(image, exposure).astype(np.float64)
    true = tone_map(reference, exposure).astype(np.float64)
    squared = float(np.mean((shown - true) ** 2))
    return min(99.0, 10.0 * math.log10(255.0**2 / squared)) if squared > 0.0 else 99.0


class Evaluator:
    """Sums of f(wi, wo) * weight over directions, for all BRDFs at once.

    Radiance is linear in a table, so the weights are first summed in the cells: all tables on one
    grid share this look-up.

    Parameters
    ----------
    brdfs : B reflectances
    """

    def __init__(self, brdfs: Sequence[Reflectance]) -> None:
        self.count = len(brdfs)
        self.tables: dict[HalfDiffGrid, tuple[list[int], Float64]] = {}
        grouped: dict[HalfDiffGrid, list[int]] = {}
        self.others: list[tuple[int, Reflectance]] = []
        for i, brdf in enumerate(brdfs):
            if isinstance(brdf, TabulatedBRDF):
                grouped.setdefault(brdf.grid, []).append(i)
            else:
                self.others.append((i, brdf))
        for grid, members in grouped.items():
            values = [brdfs[i].values.reshape(-1, 3) for i in members]  # type: ignore[attr-defined]
            self.tables[grid] = members, np.stack(values).astype(np.float64)

    def __call__(self, wi: Float64, wo: Float64, weight: Float64) -> Float64:
        """Return sums (B, 3) for local wi (m, 3), one wo (3,), and weights (m, 3) by colour."""
        result = np.zeros((self.count, 3))
        lit = (wi[:, 2] > 0.0) & (weight.max(-1) > 0.0)
        if wo[2] <= 0.0 or not lit.any():
            return result
        wi, weight = wi[lit], weight[lit]
        wos = np.broadcast_to(wo, wi.shape)
        if self.tables:
            angles = half_diff_angles(wi, wos)
        for grid, (members, values) in self.tables.items():
            index, corner = grid.stencil(*angles)
            for c in range(3):
                row = np.bincount(
                    index.ravel(), (corner * weight[:, c, None]).ravel(), minlength=grid.size
                )
                seen = np.flatnonzero(row)
                result[members, c] = values[:, seen, c] @ row[seen]
        for i, brdf in self.others:
            result[i] = np.sum(brdf.eval(wi, wos) * weight, axis=0)
        return result


class Cells(NamedTuple):
    """Lat-long rectangles of constant radiance.

    Attributes
    ----------
    light : (k, 3) radiance
    top, bottom : (k,) polar angles from +y in radians
    left, right : (k,) azimuths 2 pi u of the map in radians
    """

    light: Float64
    top: Float64
    bottom: Float64
    left: Float64
    right: Float64

    @classmethod
    def texels(cls, image: NDArray[np.float32]) -> Cells:
        """Return the texels of a map (M, N, 3) that are not black, in row-major order."""
        rows, columns, _ = image.shape
        row, column = np.nonzero(image.max(axis=-1) > 0.0)
        down, across = math.pi / rows, 2.0 * math.pi / columns
        return cls(
            image[row, column].astype(np.float64),
            row * down,
            (row + 1) * down,
            column * across,
            (column + 1) * across,
        )

    def take(self, which: NDArray[np.generic]) -> Cells:
        """Return the rectangles of an index or a mask."""
        return Cells(*(array[which] for array in self))


class Pieces:
    """The map cut into pieces that are visible or hidden as a whole.

    Parameters
    ----------
    environment : EnvironmentMap
    shadow_cell : float
        Greatest height of a piece, in radians.
    """

    def __init__(self, environment: EnvironmentMap, shadow_cell: float) -> None:
        image = environment.image
        rows, columns, _ = image.shape
        n = math.ceil(math.pi / rows / shadow_cell)
        fine = EnvironmentMap(image.repeat(n, axis=0).repeat(n, axis=1))
        shining = fine.image.max(axis=-1) > 0.0
        self.texels = Cells.texels(image)
        self.cells = Cells.texels(fine.image)
        # the texel that each piece is cut from, an index into `texels`
        number = np.cumsum(image.max(axis=-1) > 0.0).reshape(rows, columns) - 1
        row, column = np.nonzero(shining)
        self.texel = number[row // n, column // n]
        moment = texel_moments(fine)[shining]
        centroid = moment / np.linalg.norm(moment, axis=-1, keepdims=True)
        self.toward = np.asarray(turn_about_y(centroid, environment.rotation), np.float64)
        # no point of a piece is further from its centroid than this
        self.reach = np.hypot(math.pi / (rows * n), 2.0 * math.pi / (columns * n))

    def seen(self, point: int, normal: Float64, visible: Visible) -> Cells:
        """Return the light that reaches a point.

        Texels that no shadow cuts stay whole, which is faster and gives the same integral.

        Parameters
        ----------
        point : int
            Index of the point, for `visible`.
        normal : (3,) unit world vector
        visible : as for `Shadows`
        """
        above = np.flatnonzero(self.toward @ normal > -self.reach)
        clear = np.zeros(len(above), bool)
        for start in range(0, len(above), _CHUNK):
            some = above[start : start + _CHUNK]
            clear[start : start + _CHUNK] = visible(np.full(len(some), point), self.toward[some])
        count = len(self.texels.top)
        lit = np.bincount(self.texel[above[clear]], minlength=count) > 0
        shaded = np.bincount(self.texel[above[~clear]], minlength=count) > 0
        whole = self.texels.take(lit & ~shaded)
        cut = self.cells.take(above[clear & (lit & shaded)[self.texel[above]]])
        return Cells(*(np.concatenate(pair) for pair in zip(whole, cut, strict=True)))


def _mirrored(
    normals: Float64,
    views: Float64,
    brdfs: Sequence[Reflectance],
    environment: EnvironmentMap,
    visible: Visible | None,
) -> Float64:
    """Compute the radiance (n, B, 3) of the map in the mirrors (delta terms) of B reflectances."""
    weight = np.stack([brdf.mirror for brdf in brdfs]) if brdfs else np.zeros((0, 3))
    if not weight.any():
        return np.zeros((len(normals), *weight.shape))
    toward = np.asarray(reflect(views, normals), np.float64)
    light = environment.radiance(toward).astype(np.float64)
    if visible is not None:
        light *= visible(np.arange(len(normals)), toward)[:, None]
    return np.asarray(weight * light[:, None])


def _converge(
    cells: Cells,
    n: Float64,
    v: Float64,
    evaluate: Evaluator,
    tolerance: float,
    point: int,
) -> tuple[Float64, Float64]:
    """Refine the mesh until two successive integrals agree; return the last, and its error."""
    resolution = _COARSEST
    previous = integrate(cells, n, v, evaluate, resolution)
    while True:
        resolution *= 0.5
        current = integrate(cells, n, v, evaluate, resolution)
        if current is None or previous is None:
            raise IntegrationError(f"point {point}: more than {MAX_CELLS} cells needed")
        error = np.abs(current - previous).max(axis=-1, keepdims=True)
        scale = tolerance * current.max(axis=-1, keepdims=True)
        if np.all(error <= scale):
            # two meshes may agree by chance, so the stated error is not far below the tolerance
            return current, np.broadcast_to(np.maximum(error, 0.3 * scale), current.shape)
        previous = current


def integrate(
    cells: Cells,
    n: Float64,
    v: Float64,
    evaluate: Evaluator,
    resolution: float,
) -> Float64 | None:
    """Integrate the light of cells on one mesh.

    Parameters
    ----------
    cells : Cells
    n, v : (3,) unit normal, and unit direction to the viewer, in the map's frame
    evaluate : Evaluator of B reflectances
    resolution : float
        Greatest size of a cell relative to its distance from the mirror peak and the horizon.

    Returns
    -------
    (B, 3) radiance, or None if more than `MAX_CELLS` cells are needed
    """
    wo = np.asarray(to_local(v, n), np.float64)
    light, top, bottom, left, right = cells
    samples: list[tuple[Float64, Float64]] = []
    used = 0
    whole = -1.0  # irradiance that fluxes are compared with; overrates texels at the horizon
    while len(top):
        polar, azimuth = 0.5 * (top + bottom), 0.5 * (left + right)
        w = _direction(polar, azimuth)
        # no point of the cell is further from w than this: the sphere curves inwards
        straddles = (top < 0.5 * math.pi) & (bottom > 0.5 * math.pi)
        widest = np.where(straddles, 1.0, np.maximum(np.sin(top), np.sin(bottom)))
        size = 0.5 * np.hypot(bottom - top, widest * (right - left))
        cos_i = w @ n
        above = cos_i > -size
        top, bottom, left, right = top[above], bottom[above], left[above], right[above]
        light, w, size, cos_i = light[above], w[above], size[above], cos_i[above]
        polar, azimuth = polar[above], azimuth[above]
        h = w + v
        length = np.sqrt(np.sum(h * h, axis=-1))
        h /= np.maximum(length, 1e-12)[:, None]
        cross = np.cross(h, n)
        theta_h = np.arctan2(np.sqrt(np.sum(cross * cross, axis=-1)), h @ n)
        reach = size / np.maximum(length, 0.02)  # |dh| <= |dw| / (2 cos theta_d), |wi+wo| = 2 cos
        # relative to the distance from the peak, and from where both directions graze the surface
        coarse = reach / (np.maximum(theta_h - reach, 0.0) + 1e-4)
        coarse = np.maximum(coarse, size / (np.maximum(cos_i - size, 0.0) + wo[2] + 1e-4))
        at_horizon = np.abs(cos_i) < size
        cut = (coarse > resolution) | (at_horizon & (size > 0.02 * resolution))
        omega = 2.0 * np.sin(polar) * np.sin(0.5 * (bottom - top)) * (right - left)
        flux = light.sum(axis=-1) * omega
        if whole < 0.0:
            whole = float(np.sum(flux * np.maximum(cos_i, size)))
        # a small bright light needs more than one sample
        cut |= flux * np.maximum(cos_i, 0.0) > 0.25 * resolution**2 * whole
        small = ~cut & ~at_horizon & (coarse < 0.1 * resolution)
        # second order: the mean cosine over a cell is less than that at its middle
        weight = omega * cos_i * (1.0 - size * size / 6.0)
        samples.append((w[small], light[small] * weight[small, None]))
        large = ~cut & ~small
        for across in (-_GAUSS, _GAUSS):
            for down in (-_GAUSS, _GAUSS):
                t = polar + down * (bottom - top)
                share = np.sin(t) / (2.0 * np.sin(polar) * np.cos(_GAUSS * (bottom - top)))
                point = _direction(t[large], (azimuth + across * (right - left))[large])
                weight = (0.5 * share * omega)[large] * np.maximum(point @ n, 0.0)
                samples.append((point, light[large] * weight[:, None]))
        used += len(top)
        if used > MAX_CELLS:
            return None
        light = np.tile(light[cut], (4, 1))
        top, bottom, left, right = top[cut], bottom[cut], left[cut], right[cut]
        polar, azimuth = polar[cut], azimuth[cut]
        top, bottom = (
            np.concatenate([top, top, polar, polar]),
            np.concatenate([polar, polar, bottom, bottom]),
        )
        left, right = (
            np.concatenate([left, azimuth, left, azimuth]),
            np.concatenate([azimuth, right, azimuth, right]),
        )
    total = np.zeros((evaluate.count, 3))
    if samples:
        w, weight = (np.concatenate(part) for part in zip(*samples, strict=True))
        for i in range(0, len(w), _CHUNK):
            local = np.asarray(to_local(w[i : i + _CHUNK], n), np.float64)
            total += evaluate(local, wo, weight[i : i + _CHUNK])
    return total


def _check_cell(angle: float) -> None:
    """Raise ValueError unless the greatest height of a piece is an angle above 0."""
    if not angle > 0.0:
        raise ValueError(f"shadow_cell: expected an angle above 0 radians, got {angle!r}")


def _direction(polar: Float64, azimuth: Float64) -> Float64:
    """Return the map's directions (m, 3) at polar angles from +y and azimuths 2 pi u."""
    s = np.sin(polar)
    return np.stack([-s * np.sin(azimuth), np.cos(polar), s * np.cos(azimuth)], axis=-1)
