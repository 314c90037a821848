"""Labels of library members, from physical descriptors of their tables.

Never from the parameters of the recipes: what a table looks like decides, so that a measured
material would get the same label.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from traitbrdf.brdf import TabulatedBRDF

Float64 = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 luminance of linear RGB."""

SHARE = 1.0 / 3.0
"""Members in the upper third of a trait's descriptor have it, in the lower third have it not."""


def descriptors(brdf: TabulatedBRDF) -> dict[str, float]:
    """Physical descriptors of one table.

    Returns
    -------
    dict with

    - ``highlight``: difference of the cube roots of highlight and body radiance factor: contrast
      gloss on a perceptual scale (Hunter 1937; Pellacini et al. 2000, who use the cube root).
    - ``width``: log of theta_h (radians) at which the lobe falls half way from peak to body.
    - ``lightness``: cube root of the luminous albedo at 30 degrees (CIE lightness).
    - ``specular``, ``diffuse``: luminous albedo of the lobe and of the body at 30 degrees.
    - ``tint``: chroma of the highlight, the standard deviation of its log RGB.
    - ``red``, ``green``, ``blue``: log of that channel's albedo over the mean of the others'.
    """
    grid = brdf.grid
    values = np.asarray(brdf.values, np.float64)
    incidence = (grid.theta_d > math.radians(15.0)) & (grid.theta_d < math.radians(50.0))
    body_h = (grid.theta_h > math.radians(35.0)) & (grid.theta_h < math.radians(50.0))
    near = (grid.theta_d > math.radians(2.0)) & (grid.theta_d < math.radians(25.0))
    profile = values[:, incidence].mean(axis=(1, 2))  # (n_theta_h, 3)
    body = values[body_h][:, near].min(axis=(0, 1, 2))
    peak = profile[0]
    light_profile = profile @ LUMINANCE
    light_body = float(body @ LUMINANCE)
    light_peak = float(light_profile[0])
    half = light_body + 0.5 * (light_peak - light_body)
    below = np.flatnonzero(light_profile <= half)
    i = int(below[0]) if len(below) and below[0] > 0 else len(light_profile) - 1
    upper, lower = light_profile[i - 1], light_profile[i]
    part = (upper - half) / (upper - lower) if upper > lower else 1.0
    width = grid.theta_h[i - 1] + part * (grid.theta_h[i] - grid.theta_h[i - 1])
    if light_peak < 1.2 * light_body:  # no lobe stands out: as wide as the hemisphere
        width = math.pi / 4
    albedo = np.maximum(brdf.albedo(math.radians(30.0)), 1e-4)
    logs = np.log(albedo)
    diffuse = math.pi * light_body
    lobe = np.log(np.maximum(peak - body, 1e-4))
    return {
        "highlight": math.pi ** (1 / 3) * (np.cbrt(light_peak) - np.cbrt(light_body)),
        "width": math.log(max(float(width), 1e-4)),
        "lightness": float(np.cbrt(albedo @ LUMINANCE)),
        "specular": max(float(albedo @ LUMINANCE) - diffuse, 0.0),
        "diffuse": diffuse,
        "tint": float(lobe.std()),
        "red": float(logs[0] - logs[[1, 2]].mean()),
        "green": float(logs[1] - logs[[0, 2]].mean()),
        "blue": float(logs[2] - logs[[0, 1]].mean()),
    }


def trait_values(rows: Sequence[Mapping[str, float]]) -> dict[str, Float64]:
    """For each trait one number for each member: how much its descriptors speak for the trait."""
    d = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    # ranks in [0, 1] make descriptors of different units comparable
    rank = {name: np.argsort(np.argsort(v, kind="stable"), kind="stable") / len(v)
            for name, v in d.items()}  # fmt: skip
    return {
        "shiny": d["highlight"],
        "matte": -d["highlight"],
        # no body below the lobe: all light leaves as reflection
        "metallic": np.cbrt(d["specular"]) - np.cbrt(d["diffuse"]),
        # a clear, colourless highlight over a body
        "plastic": np.minimum(np.minimum(rank["highlight"], rank["diffuse"]), 1.0 - rank["tint"]),
        "rough": d["width"],
        "bright": d["lightness"],
        "red": d["red"],
        "green": d["green"],
        "blue": d["blue"],
    }


def labels(values: Float64) -> NDArray[np.int8]:
    """1 (yes) in the upper third, -1 (no) in the lower third, 0 (unclear) between."""
    low, high = np.quantile(values, [SHARE, 1.0 - SHARE])
    return np.asarray((values >= high).astype(np.int8) - (values <= low).astype(np.int8))
