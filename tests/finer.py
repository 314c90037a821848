"""A second integrator, to check the stated errors of `traitbrdf.reference`.

It uses Gauss-Legendre rules of high order on a mesh of its own, which ends exactly at the horizon.
It shares only the cells of constant light with `traitbrdf.reference`.
"""

from __future__ import annotations

import math

import numpy as np

from traitbrdf.directions import to_local

STEPS = ((0.5, 5), (0.5, 8), (0.35, 6), (0.25, 8), (0.18, 6), (0.13, 8), (0.09, 6))
"""(size, order) of ever finer runs; successive orders differ, as the cells may be the same."""
_LIMIT = 150_000


def settled(cells, n, v, models, allowed):
    """Integrate for models (B, 3); refine each until it changes by `allowed` (B,) at most.

    NaN for those that do not settle. `n` and `v` are in the map's frame.
    """
    result = np.full((len(models), 3), np.nan)
    todo, previous = np.arange(len(models)), None
    for size, order in STEPS:
        current = integral(cells, n, v, [models[b] for b in todo], size, order)
        if current is None:
            break
        if previous is not None:
            done = np.abs(current - previous).max(-1) <= allowed[todo]
            result[todo[done]] = current[done]
            todo, current = todo[~done], current[~done]
            if not len(todo):
                break
        previous = current
    return result


def integral(cells, n, v, models, size, order):
    """Integrate with cells `size` times their distance from sharp features; None if too many."""
    wo = np.asarray(to_local(v, n))
    turn = math.atan2(-n[0], n[2])  # where the horizon is highest or lowest
    inside, across = _mesh(*_halves(cells, turn), n, v, wo[2], turn, size)
    if inside is None:
        return None
    x, g = np.polynomial.legendre.leggauss(order)
    total = np.zeros((len(models), 3))
    slope = math.hypot(n[0], n[2])
    for (light, edges), cut in ((inside, False), (_at_the_horizon(*across, n[1], slope), True)):
        step = 200_000 // order**2
        for i in range(0, edges.shape[1], step):
            top, bottom, left, right = (e[:, None] for e in edges[:, i : i + step])
            if cut:  # a substitution that removes the square roots at both ends
                a = 0.5 * math.pi * (x + 1.0)
                t = 0.5 * (top + bottom) - 0.5 * (bottom - top) * np.cos(a)
                gt = 0.25 * math.pi * g * np.sin(a) * (bottom - top)
                ratio = -n[1] * np.cos(t) / np.maximum(slope * np.sin(t), 1e-300)
                arc = np.arccos(np.clip(ratio, -1.0, 1.0))
                # light is above the horizon within `arc` of `turn`: at the start of even half turns
                half = np.floor((left + right) / (2.0 * math.pi))
                even = np.mod(half, 2.0) == 0.0
                end = np.clip(half * math.pi + np.where(even, arc, math.pi - arc), left, right)
                low, high = np.where(even, left, end), np.where(even, end, right)
            else:
                t = 0.5 * (top + bottom) + 0.5 * (bottom - top) * x
                gt = 0.5 * (bottom - top) * g
                low, high = np.broadcast_to(left, t.shape), np.broadcast_to(right, t.shape)
            width = 0.5 * (high - low)[..., None]
            p = 0.5 * (low + high)[..., None] + width * x
            wi = np.asarray(to_local(_direction(t[..., None], p + turn), n))
            weight = (gt * np.sin(t))[..., None] * width * g * np.maximum(wi[..., 2], 0.0)
            for b, model in enumerate(models):
                f = model.eval(wi, np.broadcast_to(wo, wi.shape))
                total[b] += np.einsum("kijc,kij,kc->c", f, weight, light[i : i + step])
    return total


def _direction(t, p):
    s = np.sin(t)
    return np.stack(np.broadcast_arrays(-s * np.sin(p), np.cos(t), s * np.cos(p)), axis=-1)


def _halves(cells, turn):
    """Light and edges (4, k) of cells, cut at the meridian `turn` and at the opposite one."""
    left, right = cells.left - turn, cells.right - turn
    parts = []
    for k in range(-2, 3):
        a, b = np.maximum(left, k * math.pi), np.minimum(right, (k + 1) * math.pi)
        some = b > a + 1e-12
        parts.append((cells.light[some], np.stack([cells.top, cells.bottom, a, b])[:, some]))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts], axis=1)


def _mesh(light, edges, n, v, cos_o, turn, size):
    """Light and edges of cells above the horizon, and of cells that the horizon may cut."""
    done = [(light[:0], edges[:, :0], np.zeros(0, bool))]
    count = 0
    while edges.shape[1]:
        top, bottom, left, right = edges
        t, p = 0.5 * (top + bottom), 0.5 * (left + right)
        w = _direction(t, p + turn)
        straddles = (top < 0.5 * math.pi) & (bottom > 0.5 * math.pi)
        widest = np.where(straddles, 1.0, np.maximum(np.sin(top), np.sin(bottom)))
        r = 0.5 * np.hypot(bottom - top, widest * (right - left))
        above = w @ n > -r
        light, edges, w, r, t, p = (a[..., above] for a in (light.T, edges, w.T, r, t, p))
        light, w = light.T, w.T
        cos = w @ n
        h = w + v
        length = np.linalg.norm(h, axis=-1)
        h /= np.maximum(length, 1e-12)[:, None]
        theta_h = np.arctan2(np.linalg.norm(np.cross(h, n), axis=-1), h @ n)
        reach = r / np.maximum(length, 0.01)
        cut = reach > size * (np.maximum(theta_h - reach, 0.0) + 3e-4)
        cut |= r > size * (np.maximum(cos - r, 0.0) + cos_o + 3e-4)
        # light reflected back to the viewer, which the reference does not treat specially
        cut |= r > size * (np.maximum(np.linalg.norm(w - v, axis=-1) - r, 0.0) + 0.03)
        done.append((light[~cut], edges[:, ~cut], (np.abs(cos) < r)[~cut]))
        count += len(r)
        if count > _LIMIT:
            return None, None
        light, (top, bottom, left, right), t, p = (
            np.tile(light[cut], (4, 1)),
            edges[:, cut],
            *(a[cut] for a in (t, p)),
        )
        edges = np.concatenate(
            [
                np.stack([a, b, c, d])
                for a, b in ((top, t), (t, bottom))
                for c, d in ((left, p), (p, right))
            ],
            axis=1,
        )
    light = np.concatenate([d[0] for d in done])
    edges = np.concatenate([d[1] for d in done], axis=1)
    low = np.concatenate([d[2] for d in done])
    return (light[~low], edges[:, ~low]), (light[low], edges[:, low])


def _at_the_horizon(light, edges, up, slope):
    """Divide cells in three by height: the horizon crosses the middle one corner to corner."""
    top, bottom, left, right = edges
    cross = [
        np.clip(np.mod(np.arctan2(-up, slope * np.cos(u)), math.pi), top, bottom)
        for u in (left, right)
    ]
    marks = [top, np.minimum(*cross), np.maximum(*cross), bottom]
    parts = [np.stack([marks[i], marks[i + 1], left, right]) for i in range(3)]
    return np.concatenate([light] * 3), np.concatenate(parts, axis=1)
