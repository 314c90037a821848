"""The oracle: brute-force integration of the reflection equation in float64.

I(x, wo) = integral of L(wi) rho(wi, wo) max(0, wi.n) d omega over the texels of the map (piecewise
constant) plus the lights beside it. Slow and simple on purpose: every texel above the horizon is
visited, texels are cut until they are small against their distance from the mirror peak, and the
whole mesh is refined until two successive answers agree. It shares no quadrature with
`traitbrdf.transport`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from traitbrdf.brdf import HalfDiffGrid, Reflectance, TabulatedBRDF
from traitbrdf.directions import half_diff_angles, reflect, to_local
from traitbrdf.lights import EnvironmentMap, Light
from traitbrdf.scene import Scene

Float64 = NDArray[np.float64]

_COARSEST = 0.2
_MAX_CELLS = 4_000_000


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
        The radiance and the estimate of its own absolute error.

    Raises
    ------
    IntegrationError
        If the estimate stays above the tolerance.
    ValueError
        If point lights come without positions.
    """
    count = len(normals)
    if positions is None:
        if any(not hasattr(light, "direction") for light in lights):
            raise ValueError("positions: point lights need the (n, 3) positions of the points")
        positions = np.zeros((count, 3))
    result = np.zeros((count, len(brdfs), 3))
    error = np.zeros_like(result)
    evaluate = _evaluator(brdfs)
    for p in range(count):
        n, v = normals[p], views[p]
        if environment is not None:
            result[p], error[p] = _converge(environment, n, v, evaluate, tolerance, p)
            mirror_light = environment.radiance(reflect(v, n)).astype(np.float64)
            result[p] += np.stack([b.mirror for b in brdfs]) * mirror_light
        wo = to_local(v, n)
        for light in lights:
            toward, irradiance = light.arriving(positions[p : p + 1])
            wi = to_local(toward, n[None])
            cos = np.maximum(wi[:, 2], 0.0)
            result[p] += evaluate(wi, wo, irradiance * cos[:, None])
    return result, error


def render(
    scene: Scene,
    brdfs: Reflectance | Mapping[str, Reflectance],
    tolerance: float = 1e-4,
) -> Float64:
    """The whole frame (H, W, 3), linear radiance, backdrop included.

    Parameters
    ----------
    brdfs : one reflectance for all parts, or one for each part by name
    """
    image = scene.backdrop().astype(np.float64)
    flat = image.reshape(-1, 3)
    for index, name in enumerate(scene.parts):
        inside = scene.pixel_part == index
        if not inside.any():
            continue
        brdf = brdfs[name] if isinstance(brdfs, Mapping) else brdfs
        values, _ = radiance(
            scene.normals[inside],
            scene.views[inside],
            [brdf],
            scene.environment,
            scene.lights,
            scene.positions[inside],
            tolerance,
        )
        flat[scene.pixels[inside]] = values[:, 0]
    return image


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


_evaluator = _Evaluator


def _converge(
    environment: EnvironmentMap,
    normal: Float64,
    view: Float64,
    evaluate: _Evaluator,
    tolerance: float,
    pixel: int,
) -> tuple[Float64, Float64]:
    n, v = environment.to_map(normal), environment.to_map(view)
    wo = to_local(v, n)
    resolution = _COARSEST
    previous = _integrate(environment, n, v, wo, evaluate, resolution)
    while True:
        resolution *= 0.5
        current = _integrate(environment, n, v, wo, evaluate, resolution)
        if current is None or previous is None:
            raise IntegrationError(f"point {pixel}: more than {_MAX_CELLS} cells needed")
        error = np.abs(current - previous)
        scale = current.max(axis=-1, keepdims=True)
        if np.all(error <= tolerance * scale):
            return current, error
        previous = current


def _integrate(
    environment: EnvironmentMap,
    n: Float64,
    v: Float64,
    wo: Float64,
    evaluate: _Evaluator,
    resolution: float,
) -> Float64 | None:
    """The integral with cells no larger than `resolution` times their distance from the peak."""
    rows, columns, _ = environment.image.shape
    row, column = np.nonzero(environment.image.max(axis=-1) > 0.0)
    light = environment.image[row, column].astype(np.float64)
    top, bottom = environment.row_edges[row], environment.row_edges[row + 1]
    left = column * (2.0 * math.pi / columns)
    right = (column + 1) * (2.0 * math.pi / columns)
    total = np.zeros((evaluate.count, 3))
    whole = environment.irradiance(n).sum()
    cells = 0
    while len(top):
        middle = 0.5 * (left + right)
        # the polar angle that halves the solid angle
        polar = np.arccos(np.clip(np.cos(0.5 * (top + bottom)) * np.cos(0.5 * (bottom - top)), -1, 1))
        s = np.sin(polar)
        w = np.stack([-s * np.sin(middle), np.cos(polar), s * np.cos(middle)], axis=-1)
        size = 0.5 * np.hypot(bottom - top, np.maximum(np.sin(top), np.sin(bottom))
                              * (right - left))  # fmt: skip
        cos_i = w @ n
        above = cos_i > -size
        top, bottom, left, right = top[above], bottom[above], left[above], right[above]
        light, w, size, cos_i = light[above], w[above], size[above], cos_i[above]
        h = w + v
        length = np.sqrt(np.sum(h * h, axis=-1))
        h /= np.maximum(length, 1e-12)[:, None]
        cross = np.cross(h, n)
        theta_h = np.arctan2(np.sqrt(np.sum(cross * cross, axis=-1)), h @ n)
        reach = size / np.maximum(length, 0.02)  # |dh| <= |dw| / (2 cos theta_d), |wi+wo| = 2 cos
        near = np.maximum(theta_h - reach, 0.0)
        cut = reach > resolution * (near + 1e-4)
        cut |= (np.abs(cos_i) < size) & (size > 0.02 * resolution)
        band = 2.0 * np.sin(0.5 * (top + bottom)) * np.sin(0.5 * (bottom - top))
        omega = band * (right - left)
        share = light.sum(axis=-1) * omega * np.maximum(cos_i, 0.0) / whole
        cut |= share > 0.25 * resolution**2  # a small bright light deserves more than one sample
        keep = ~cut
        local = to_local(w[keep], np.broadcast_to(n, (int(keep.sum()), 3)))
        weight = light[keep] * (omega[keep] * np.maximum(cos_i[keep], 0.0))[:, None]
        total += evaluate(local, wo, weight)
        cells += len(top)
        if cells > _MAX_CELLS:
            return None
        top, bottom, left, right = top[cut], bottom[cut], left[cut], right[cut]
        light = np.tile(light[cut], (4, 1))
        half_v, half_u = 0.5 * (top + bottom), 0.5 * (left + right)
        top, bottom = (
            np.concatenate([top, top, half_v, half_v]),
            np.concatenate([half_v, half_v, bottom, bottom]),
        )
        left, right = (
            np.concatenate([left, half_u, left, half_u]),
            np.concatenate([half_u, right, half_u, right]),
        )
    return total
