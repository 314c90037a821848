"""The oracle: brute-force integration of the reflection equation in float64.

I(x, wo) = integral of L(wi) rho(wi, wo) max(0, wi.n) d omega over the texels of the map (piecewise
constant) plus the lights beside it. Slow and simple on purpose: every texel above the horizon is
visited, texels are cut until they are small against their distance from the mirror peak and from
the horizon, and the whole mesh is refined until two successive answers agree. It shares no
quadrature with `traitbrdf.transport`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import HalfDiffGrid, Reflectance, TabulatedBRDF
from traitbrdf.directions import half_diff_angles, reflect, to_local
from traitbrdf.formats import exposure_of, tone_map
from traitbrdf.lights import EnvironmentMap, Light, PointLight
from traitbrdf.scene import Scene

Float64 = NDArray[np.float64]

_COARSEST = 0.2
_MAX_CELLS = 1_000_000
_CHUNK = 1 << 17
_GAUSS = 0.5 / math.sqrt(3.0)  # the two Gauss-Legendre points, from the middle, in widths


class IntegrationError(RuntimeError):
    """The asked tolerance was not reached; the message says where and how far off."""


def radiance(
    normals: Float64,
    views: Float64,
    brdfs: Sequence[Reflectance],
    environment: EnvironmentMap | None = None,
    lights: Sequence[Light] = (),
    positions: Float64 | None = None,
    tolerance: float = 1e-4,
) -> tuple[Float64, Float64]:
    """Radiance that leaves surface points towards the viewer, unshadowed.

    Parameters
    ----------
    normals, views : (n, 3) world unit vectors, views towards the viewer and above the surface
    brdfs : B reflectances; each point is computed for all of them
    environment, lights : what shines
    positions : (n, 3) world positions, needed for point lights
    tolerance : relative to the pixel's largest channel

    Returns
    -------
    radiance, error : (n, B, 3)
        The radiance and the estimate of its own absolute error, one for the three channels: what
        the last refinement changed, but at least 0.3 times the tolerance.

    Raises
    ------
    IntegrationError
        If the estimate stays above the tolerance.
    ValueError
        If point lights come without positions.
    """
    count = len(normals)
    if positions is None:
        if any(isinstance(light, PointLight) for light in lights):
            raise ValueError("positions: point lights need the (n, 3) positions of the points")
        positions = np.zeros((count, 3))
    result = np.zeros((count, len(brdfs), 3))
    error = np.zeros_like(result)
    evaluate = _Evaluator(brdfs)
    for p in range(count):
        n, v = normals[p], views[p]
        if environment is not None:
            result[p], error[p] = _converge(environment, n, v, evaluate, tolerance, p)
            mirror_light = environment.radiance(reflect(v, n)).astype(np.float64)
            result[p] += np.stack([b.mirror for b in brdfs]) * mirror_light
        wo = np.asarray(to_local(v, n), np.float64)
        for light in lights:
            toward, irradiance = light.arriving(positions[p : p + 1])
            wi = np.asarray(to_local(toward, n[None]), np.float64)
            cos = np.maximum(wi[:, 2], 0.0)
            result[p] += evaluate(wi, wo, irradiance * cos[:, None])
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
    tolerance : of each pixel, relative to its largest channel
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
    done = 0
    for index, name in enumerate(scene.parts):
        pixels = np.flatnonzero(scene.pixel_part == index)
        for some in np.array_split(pixels, math.ceil(len(pixels) / 64)) if len(pixels) else []:
            values, _ = radiance(
                scene.normals[some],
                scene.views[some],
                [brdfs[name] if isinstance(brdfs, Mapping) else brdfs],
                scene.environment,
                scene.lights,
                scene.positions[some],
                tolerance,
            )
            flat[scene.pixels[some]] = values[:, 0]
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


class _Evaluator:
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


def _converge(
    environment: EnvironmentMap,
    normal: Float64,
    view: Float64,
    evaluate: _Evaluator,
    tolerance: float,
    pixel: int,
) -> tuple[Float64, Float64]:
    n = np.asarray(environment.to_map(normal), np.float64)
    v = np.asarray(environment.to_map(view), np.float64)
    resolution = _COARSEST
    previous = _integrate(environment, n, v, evaluate, resolution)
    while True:
        resolution *= 0.5
        current = _integrate(environment, n, v, evaluate, resolution)
        if current is None or previous is None:
            raise IntegrationError(f"point {pixel}: more than {_MAX_CELLS} cells needed")
        error = np.abs(current - previous).max(axis=-1, keepdims=True)
        scale = tolerance * current.max(axis=-1, keepdims=True)
        if np.all(error <= scale):
            # two meshes may agree by chance: no claim to be much better than asked
            return current, np.broadcast_to(np.maximum(error, 0.3 * scale), current.shape)
        previous = current


def _integrate(
    environment: EnvironmentMap,
    n: Float64,
    v: Float64,
    evaluate: _Evaluator,
    resolution: float,
) -> Float64 | None:
    """The integral with cells no larger than `resolution` times their distance from the peak.

    `n` and `v` are in the map's frame. None if it takes too many cells.
    """
    columns = environment.image.shape[1]
    wo = np.asarray(to_local(v, n), np.float64)
    row, column = np.nonzero(environment.image.max(axis=-1) > 0.0)
    light = environment.image[row, column].astype(np.float64)
    top, bottom = environment.row_edges[row], environment.row_edges[row + 1]
    left = column * (2.0 * math.pi / columns)
    right = (column + 1) * (2.0 * math.pi / columns)
    samples: list[tuple[Float64, Float64]] = []
    cells = 0
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
        cells += len(top)
        if cells > _MAX_CELLS:
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


def _direction(polar: Float64, azimuth: Float64) -> Float64:
    """Map directions (m, 3) at polar angles from +y and azimuths 2 pi u."""
    s = np.sin(polar)
    return np.stack([-s * np.sin(azimuth), np.cos(polar), s * np.cos(azimuth)], axis=-1)
