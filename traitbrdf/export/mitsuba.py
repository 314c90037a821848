"""Scenes for Mitsuba 3: a Python file and its arrays, with the tables as they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.export import mitsuba_scene
from traitbrdf.export.pieces import Piece
from traitbrdf.formats.files import atomic_path, write_arrays
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.descriptors import LUMINANCE
from traitbrdf.scene.lights import PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Sphere

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class MitsubaPart:
    """One part of a scene.

    Attributes
    ----------
    piece : Piece
    tables : sequence of TabulatedBRDF
        One, or those that `paint` blends.
    paint : dict of arrays or None
        ``cell``, ``share`` and ``corners`` as `mitsuba_scene.table_material` takes them.
    """

    piece: Piece
    tables: Sequence[TabulatedBRDF]
    paint: dict[str, NDArray[Any]] | None = None


def write_mitsuba(path: str | PathLike[str], scene: Scene, parts: Sequence[MitsubaPart]) -> None:
    """Write ``scene.py``, which is `mitsuba_scene` itself, and ``scene.npz`` beside it.

    Parameters
    ----------
    path : path-like, of the Python file
    scene : Scene
    parts : sequence of MitsubaPart

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    shape, camera, environment = scene.shape, scene.camera, scene.environment
    target = shape.center if camera.target is None else camera.target
    lights = scene.lights
    arrays: dict[str, NDArray[Any]] = {
        "map": environment.image,
        "rotation": np.array(environment.rotation),
        "parts": np.array([part.piece.name for part in parts]),
        "size": np.array([scene.height, scene.width]),
        "fov": np.array(camera.fov),
        "eye": np.asarray(camera.position(shape, scene.height, scene.width)),
        "target": np.asarray(target, np.float64),
        "light_point": np.array([isinstance(light, PointLight) for light in lights], np.bool_),
        "light_place": np.array(
            [one.position if isinstance(one, PointLight) else one.direction for one in lights]
        ).reshape(-1, 3),
        "light_power": np.array(
            [one.intensity if isinstance(one, PointLight) else one.irradiance for one in lights]
        ).reshape(-1, 3),
    }
    for i, part in enumerate(parts):
        piece, first = part.piece, part.tables[0]
        alpha, even = fit_lobe(first)
        said: dict[str, Any] = {
            "tables": np.stack([table.values for table in part.tables]).astype(np.float32),
            "alpha": alpha, "even": even, "mirror": first.mirror, **(part.paint or {}),
        }  # fmt: skip
        if isinstance(shape, Sphere) and piece.name in shape.parts and part.paint is None:
            said |= {"center": shape.center, "radius": shape.radius}
        else:
            uvs = np.zeros((len(piece.positions), 2)) if piece.uvs is None else piece.uvs
            said |= {
                "positions": piece.positions.astype(np.float32),
                "normals": piece.normals.astype(np.float32),
                "uvs": uvs.astype(np.float32),
                "faces": piece.faces.astype(np.uint32),
            }
        arrays |= {f"{i}/{name}": np.asarray(value) for name, value in said.items()}
    write_arrays(Path(path).with_suffix(".npz"), arrays)
    with atomic_path(path) as temporary:
        temporary.write_text(Path(mitsuba_scene.__file__).read_text(encoding="utf-8"), "utf-8")


def fit_lobe(table: TabulatedBRDF) -> tuple[float, float]:
    """Fit the sampling density: a GGX lobe mixed with cosine-distributed directions.

    The fit minimises the variance of samples of the table under even light.

    Parameters
    ----------
    table : TabulatedBRDF

    Returns
    -------
    alpha, even : float
        Roughness of the lobe and share of cosine-distributed directions, as
        `mitsuba_scene.table_material` takes them.
    """
    # a quadrature over half vectors that is dense at narrow lobes
    edges = (np.arange(161) / 160) ** 3 * (math.pi / 2)
    theta, step = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    phi = (np.arange(32) + 0.5) * (math.pi / 32)
    th, ph = np.meshgrid(theta, phi, indexing="ij")
    half = np.stack([np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)], axis=-1)
    around = np.repeat((step * np.sin(theta))[:, None], len(phi), axis=1)
    alphas, shares = np.geomspace(0.004, 1.0, 40), np.linspace(0.05, 1.0, 20)
    variance = np.zeros((len(alphas), len(shares)))
    for cosine in (0.95, 0.75, 0.5, 0.3):
        view = np.array([math.sqrt(1.0 - cosine**2), 0.0, cosine])
        meet = half @ view
        light = 2.0 * meet[..., None] * half - view
        lit = (meet > 1e-6) & (light[..., 2] > 1e-6)
        h, w, area = half[lit][:, 2], light[lit], (4.0 * meet * around)[lit]
        value = table.eval(w, np.broadcast_to(view, w.shape)) @ LUMINANCE * w[:, 2]
        even = w[:, 2] / math.pi
        total = np.sum(value * area)
        for a, alpha in enumerate(alphas):
            d = alpha**2 / (math.pi * (h**2 * (alpha**2 - 1.0) + 1.0) ** 2)
            masked = 2.0 / (1.0 + math.sqrt(1.0 + (alpha / cosine) ** 2 * (1.0 - cosine**2)))
            lobe = d * masked / (4.0 * cosine)
            for s, share in enumerate(shares):
                pdf = share * even + (1.0 - share) * lobe
                variance[a, s] += np.sum(value**2 / pdf * area) / total**2
    best = np.unravel_index(np.argmin(variance), variance.shape)
    return float(alphas[best[0]]), float(shares[best[1]])
