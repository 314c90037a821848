"""The oracle: brute-force integration of the reflection equation in float64.

I(x, wo) = integral of L(wi) V(x, wi) rho(wi, wo) max(0, wi.n) d omega over the texels of the map
(piecewise constant) plus the lights beside it. Slow and simple on purpose: every texel above the
horizon is visited, texels are cut until they are small against their distance from the mirror peak
and from the horizon, and the whole mesh is refined until two successive answers agree. It shares no
quadrature with `traitbrdf.transport`.

Shadows are defined so that there is one truth to converge to. Each texel is divided into n x n
pieces equal in both angles, with the least n for which none is taller than `SHADOW_CELL`; a piece
is wholly visible or wholly hidden, as the one ray towards the centroid of its solid angle says. At
one point the visible light is then again piecewise constant, and the stated errors concern its
integral. What the pieces themselves are off by is not in them: the edge of a shadow passes through
them, so the penumbra of a light k pieces wide has about k steps where that edge runs along their
sides, and many more where it runs across. The mirror's delta term sends one ray in its own
direction, a point or directional light one to the light.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.directions import half_diff_angles, reflect, to_local
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.reflectance.brdf import HalfDiffGrid, Reflectance, TabulatedBRDF
from traitbrdf.scene.lights import EnvironmentMap, Light, PointLight, texel_moments, turn_about_y
from traitbrdf.scene.scene import Scene

Float64 = NDArray[np.float64]
Index = NDArray[np.int64]
Visible: TypeAlias = Callable[[Index, Float64], NDArray[np.bool_]]
"""Whether light from infinity reaches points (m,) from world directions (m, 3): (m,) booleans."""
Arriving: TypeAlias = tuple[Float64, Float64]
"""World directions to a light and irradiance across them, (n, 3) each, as the n points get them."""

SHADOW_CELL = 0.0125
"""Greatest height in radians of a piece of the map that is visible or hidden as a whole."""

_COARSEST = 0.2
MAX_CELLS = 1_000_000
_CHUNK = 1 << 17
_BLOCK = 256  # samples whose results are kept at a time
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
    """The asked tolerance was not reached; the message says where and how far off."""


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
    """Radiance that leaves surface points towards the viewer.

    Parameters
    ----------
    normals, views : (n, 3) world unit vectors, views towards the viewer and above the surface
    brdfs : B reflectances; each point is computed for all of them
    environment : the map that shines
    lights : what shines beside it
        Lights, which meet no shadow, or pairs (directions, irradiance) of light as it arrives.
    positions : (n, 3) world positions, needed for point lights
    tolerance : relative to the pixel's largest channel
    shadows : Shadows or None
        What the map's light meets on its way to the points; None lets all of it pass.

    Returns
    -------
    radiance, error : (n, B, 3)
        The radiance and the estimate of its own absolute error, one for the three channels: what
        the last refinement changed, but at least 0.3 times the tolerance. An estimate and no bound:
        it held the true error in 99.7 % of 3,000 random cases at tolerances of 1e-2 to 1e-4. All
        that it missed by more than a factor of 3 were radiances below 1e-26, far out in the tail
        of a sharp lobe.

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


def fragments(
    scene: Scene,
    index: ArrayLike,
    brdfs: Sequence[Reflectance],
    tolerance: float = 1e-4,
    shadow_cell: float = SHADOW_CELL,
) -> tuple[Float64, Float64]:
    """What fragments of a scene add to their pixels, in all its light and shadows.

    The sum over a fragment's samples of their share of the pixel times their radiance: a fragment
    that covers a tenth of its pixel adds a tenth of its radiance.

    Parameters
    ----------
    index : (m,) array_like of int
        Which fragments of the scene.
    brdfs : B reflectances; each fragment is computed for all of them
    tolerance : of each sample, relative to its largest channel
    shadow_cell : radians, as for `radiance`

    Returns
    -------
    radiance, error : (m, B, 3)
        As `radiance` gives them; the errors of a fragment's samples add up.

    Raises
    ------
    IntegrationError
        As `radiance` does; the points in its message are those of one block of samples.
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


def render(
    scene: Scene,
    brdfs: Reflectance | Mapping[str, Reflectance],
    tolerance: float = 1e-4,
    progress: Callable[[str, float], None] | None = None,
) -> Float64:
    """The whole frame (H, W, 3), linear radiance, backdrop included.

    Parameters
    ----------
    brdfs : one reflectance for all parts, or one for each part by name
    tolerance : of each sample, relative to its largest channel
    progress : called with ("reference", fraction done); may raise to cancel

    Raises
    ------
    IntegrationError
        As `radiance` does.
    ValueError
        If a part that is seen has no reflectance.
    """
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
    """Mean relative L1: mean|I - I_ref| / mean(I_ref), linear radiance of the same shape."""
    shown, true = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if shown.shape != true.shape:
        raise ValueError(f"image: expected the reference's shape {true.shape}, got {shown.shape}")
    level = true.mean()
    deviation = np.abs(shown - true).mean()
    return float(deviation / level) if level > 0.0 else float(deviation)


def tone_mapped_psnr(image: ArrayLike, reference: ArrayLike) -> float:
    """PSNR in dB of the tone-mapped pictures (..., 3), exposed for the reference; at most 99."""
    exposure = exposure_of(reference)
    shown = tone_map(image, exposure).astype(np.float64)
    true = tone_map(reference, exposure).astype(np.float64)
    squared = float(np.mean((shown - true) ** 2))
    return min(99.0, 10.0 * math.log10(255.0**2 / squared)) if squared > 0.0 else 99.0


class Evaluator:
    """Sums f(wi, wo) * weight over directions, for all BRDFs at once.

    Tables on one grid share the look-up: radiance is linear in the table, so the weights are first
    gathered on the cells.
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
        """(B, 3) sums for local wi (m, 3), one wo (3,), and weight (m, 3) per colour."""
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
    """Lat-long rectangles of constant light: radiance (k, 3), and their edges (k,) in radians.

    `top` and `bottom` are polar angles from +y, `left` and `right` azimuths 2 pi u of the map.
    """

    light: Float64
    top: Float64
    bottom: Float64
    left: Float64
    right: Float64

    @classmethod
    def texels(cls, image: NDArray[np.float32]) -> Cells:
        """The texels of a map (M, N, 3) that shine, in row-major order."""
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
        """The rectangles of an index or a mask."""
        return Cells(*(array[which] for array in self))


class Pieces:
    """The map cut into what is visible or hidden as a whole."""

    def __init__(self, environment: EnvironmentMap, shadow_cell: float) -> None:
        image = environment.image
        rows, columns, _ = image.shape
        n = math.ceil(math.pi / rows / shadow_cell)
        fine = EnvironmentMap(image.repeat(n, axis=0).repeat(n, axis=1))
        shining = fine.image.max(axis=-1) > 0.0
        self.texels = Cells.texels(image)
        self.cells = Cells.texels(fine.image)
        # the texel that each piece is cut from, counted as in `texels`
        number = np.cumsum(image.max(axis=-1) > 0.0).reshape(rows, columns) - 1
        row, column = np.nonzero(shining)
        self.texel = number[row // n, column // n]
        moment = texel_moments(fine)[shining]
        centroid = moment / np.linalg.norm(moment, axis=-1, keepdims=True)
        self.toward = np.asarray(turn_about_y(centroid, environment.rotation), np.float64)
        # no point of a piece is further from its centroid than this
        self.reach = np.hypot(math.pi / (rows * n), 2.0 * math.pi / (columns * n))

    def seen(self, point: int, normal: Float64, visible: Visible) -> Cells:
        """The light that reaches a point with a world normal (3,).

        Texels that are not cut by a shadow stay whole: the integral is the same and sooner done.
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
    """What the mirrors (delta terms) of B reflectances show of the map, (n, B, 3)."""
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
            # two meshes may agree by chance: no claim to be much better than asked
            return current, np.broadcast_to(np.maximum(error, 0.3 * scale), current.shape)
        previous = current


def integrate(
    cells: Cells,
    n: Float64,
    v: Float64,
    evaluate: Evaluator,
    resolution: float,
) -> Float64 | None:
    """The integral with cells no larger than `resolution` times their distance from the peak.

    `n` and `v` are in the map's frame. None if it takes too many cells.
    """
    wo = np.asarray(to_local(v, n), np.float64)
    light, top, bottom, left, right = cells
    samples: list[tuple[Float64, Float64]] = []
    used = 0
    whole = -1.0  # the irradiance, texels at the horizon overrated: what cells are measured against
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
        # against the distance from the peak, and from where both directions graze the surface
        coarse = reach / (np.maximum(theta_h - reach, 0.0) + 1e-4)
        coarse = np.maximum(coarse, size / (np.maximum(cos_i - size, 0.0) + wo[2] + 1e-4))
        at_horizon = np.abs(cos_i) < size
        cut = (coarse > resolution) | (at_horizon & (size > 0.02 * resolution))
        omega = 2.0 * np.sin(polar) * np.sin(0.5 * (bottom - top)) * (right - left)
        flux = light.sum(axis=-1) * omega
        if whole < 0.0:
            whole = float(np.sum(flux * np.maximum(cos_i, size)))
        # a small bright light deserves more than one sample
        cut |= flux * np.maximum(cos_i, 0.0) > 0.25 * resolution**2 * whole
        small = ~cut & ~at_horizon & (coarse < 0.1 * resolution)
        # over a cell the cosine averages to less than at its middle, by its second derivative
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
    """Map directions (m, 3) at polar angles from +y and azimuths 2 pi u."""
    s = np.sin(polar)
    return np.stack([-s * np.sin(azimuth), np.cos(polar), s * np.cos(azimuth)], axis=-1)
