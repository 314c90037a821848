from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, inline="always")
def _split(theta_d_len: float, size: float, q: float, theta_h: float, floor: float) -> bool:
    return True


@numba.njit(cache=True, error_model="numpy")
def _fill_row(
    row, n, v, flux, direction, radius, child, rect, image, n_h, n_d, n_p, q, s0, cutoff, stack, cells
):
    """Add one point's weights to `row` (3, cells); returns the number of nodes used."""
    half_pi = 0.5 * math.pi
    rows, columns = image.shape[0], image.shape[1]
    used = 0
    # irradiance from a coarse walk: what a bright node is measured against
    top = 0
    stack[0] = 0
    total = 0.0
    while top >= 0:
        i = stack[top]
        top -= 1
        cos_i = n[0] * direction[i, 0] + n[1] * direction[i, 1] + n[2] * direction[i, 2]
        r = radius[i]
        if cos_i < -1.5 * r:
            continue
        if r > 0.2 and (child[i, 0] >= 0 or child[i, 1] >= 0):
            for s in range(2):
                if child[i, s] >= 0:
                    top += 1
                    stack[top] = child[i, s]
        elif cos_i > 0.0:
            total += (flux[i, 0] + flux[i, 1] + flux[i, 2]) * cos_i
    if total <= 0.0:
        total = 1e-30
    share0 = s0
    top = 0
    stack[0] = 0
    sub = -1
    while top >= 0 or sub >= 0:
        in_texel = sub >= 0
        if in_texel:
            t0, t1, f0, f1 = cells[sub, 0], cells[sub, 1], cells[sub, 2], cells[sub, 3]
            i = int(cells[sub, 4])
            sub -= 1
            tm, fm = 0.5 * (t0 + t1), 0.5 * (f0 + f1)
            st, ct = math.sin(tm), math.cos(tm)
            cx, cy, cz = -st * math.sin(fm), ct, st * math.cos(fm)
            omega = 2.0 * st * math.sin(0.5 * (t1 - t0)) * (f1 - f0)
            pr, pc = rect[i, 0], rect[i, 2]
            e0, e1, e2 = image[pr, pc, 0] * omega, image[pr, pc, 1] * omega, image[pr, pc, 2] * omega
            r = 0.5 * math.sqrt((t1 - t0) ** 2 + (st * (f1 - f0)) ** 2)
        else:
            i = stack[top]
            top -= 1
            cx, cy, cz = direction[i, 0], direction[i, 1], direction[i, 2]
            e0, e1, e2 = flux[i, 0], flux[i, 1], flux[i, 2]
            r = radius[i]
        cos_i = n[0] * cx + n[1] * cy + n[2] * cz
        if cos_i < -1.5 * r:
            continue
        hx, hy, hz = cx + v[0], cy + v[1], cz + v[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        inv = 1.0 / max(length, 1e-6)
        hx *= inv
        hy *= inv
        hz *= inv
        px = hy * n[2] - hz * n[1]
        py = hz * n[0] - hx * n[2]
        pz = hx * n[1] - hy * n[0]
        sin_h = math.sqrt(px * px + py * py + pz * pz)
        cos_h = hx * n[0] + hy * n[1] + hz * n[2]
        reach = r / max(length, 0.1)
        # at wide angles sin stands in for the angle
        near = max(sin_h - reach, 0.0)
        spacing = q * (near + 1e-3)
        share = (e0 + e1 + e2) * max(cos_i, r) / total
        if share > share0:
            spacing *= max(0.25, math.sqrt(share0 / share))
        cut = reach > spacing or (abs(cos_i) < r and r > cutoff) or r > 0.15
        if cut:
            if in_texel:
                if sub + 4 < cells.shape[0] and r > 1e-5:
                    for a in range(4):
                        sub += 1
                        cells[sub, 0] = t0 if a < 2 else tm
                        cells[sub, 1] = tm if a < 2 else t1
                        cells[sub, 2] = f0 if a % 2 == 0 else fm
                        cells[sub, 3] = fm if a % 2 == 0 else f1
                        cells[sub, 4] = i
                    continue
            elif rect[i, 1] - rect[i, 0] == 1 and rect[i, 3] - rect[i, 2] == 1:
                sub += 1
                cells[sub, 0] = rect[i, 0] * (math.pi / rows)
                cells[sub, 1] = rect[i, 1] * (math.pi / rows)
                cells[sub, 2] = rect[i, 2] * (2.0 * math.pi / columns)
                cells[sub, 3] = rect[i, 3] * (2.0 * math.pi / columns)
                cells[sub, 4] = i
                # the texel itself is cut at once
                tm, fm = 0.5 * (cells[sub, 0] + cells[sub, 1]), 0.5 * (cells[sub, 2] + cells[sub, 3])
                t0, t1, f0, f1 = cells[sub, 0], cells[sub, 1], cells[sub, 2], cells[sub, 3]
                sub -= 1
                for a in range(4):
                    sub += 1
                    cells[sub, 0] = t0 if a < 2 else tm
                    cells[sub, 1] = tm if a < 2 else t1
                    cells[sub, 2] = f0 if a % 2 == 0 else fm
                    cells[sub, 3] = fm if a % 2 == 0 else f1
                    cells[sub, 4] = i
                continue
            else:
                for s in range(2):
                    if child[i, s] >= 0:
                        top += 1
                        stack[top] = child[i, s]
                continue
        if cos_i <= 0.0:
            continue
        used += 1
        dx, dy, dz = cx - v[0], cy - v[1], cz - v[2]
        theta_d = math.atan2(math.sqrt(dx * dx + dy * dy + dz * dz), length)
        theta_h = math.atan2(sin_h, cos_h)
        across = abs(cx * px + cy * py + cz * pz)
        along = abs(0.5 * length * cos_h - cos_i)
        phi_d = math.atan2(across, along)
        x = math.sqrt(theta_h / half_pi) * (n_h - 1)
        a0 = min(int(x), n_h - 2)
        lo = (a0 / (n_h - 1)) ** 2 * half_pi
        hi = ((a0 + 1) / (n_h - 1)) ** 2 * half_pi
        fa = (theta_h - lo) / (hi - lo)
        y = theta_d / half_pi * (n_d - 1)
        b0 = min(int(y), n_d - 2)
        fb = y - b0
        z = phi_d / half_pi * (n_p - 1)
        c0 = min(int(z), n_p - 2)
        fc = z - c0
        base = (a0 * n_d + b0) * n_p + c0
        for a in range(2):
            wa = cos_i * (fa if a else 1.0 - fa)
            for b in range(2):
                wb = wa * (fb if b else 1.0 - fb)
                for c in range(2):
                    w = wb * (fc if c else 1.0 - fc)
                    k = base + (a * n_d + b) * n_p + c
                    row[0, k] += w * e0
                    row[1, k] += w * e1
                    row[2, k] += w * e2
    return used


@numba.njit(parallel=True, cache=True, error_model="numpy")
def fill_rows(out, used, normals, views, flux, direction, radius, child, rect, image, n_h, n_d, n_p, q, s0, cutoff):
    for p in numba.prange(len(normals)):
        stack = np.empty(256, np.int32)
        cells = np.empty((256, 5), np.float64)
        out[p] = 0.0
        used[p] = _fill_row(
            out[p], normals[p], views[p], flux, direction, radius, child, rect, image,
            n_h, n_d, n_p, q, s0, cutoff, stack, cells,
        )
