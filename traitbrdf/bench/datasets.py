"""Data for the benches: maps, unseen materials and measured materials."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from traitbrdf.directions import from_half_diff_angles
from traitbrdf.recipes.materials import materials
from traitbrdf.reflectance import models
from traitbrdf.reflectance.brdf import (
    TabulatedBRDF,
)
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.session.preparation import trained_members
from traitbrdf.space.library import Library, default_library
from traitbrdf.space.traits import default_traits
from traitbrdf.transport.basis import Training, training_tables

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

HELD_OUT = 10
"""Every `HELD_OUT`-th library member is left out of the training of measured bases."""

LEFT_OUT = ("polished-metal", "car-paint", "rubber", "silk", "velvet", "dusty")
"""Families that are left out of training, one at a time."""


# -- maps and materials ---------------------------------------------------------------------------


def maps(data: Path | None, quick: bool) -> list[tuple[str, EnvironmentMap]]:
    """Return named maps: those of ``data/envmaps``, or else the procedural sky, plain and turned.

    Parameters
    ----------
    data : Path or None
    quick : bool
        Whether to return one map only.
    """
    files = sorted((data / "envmaps").glob("*.exr")) if data else []
    if not files:
        sky = EnvironmentMap.sky()
        return [("sky", sky)] if quick else [("sky", sky), ("sky turned", sky.rotated(2.0))]
    return [(f.stem, EnvironmentMap.read(f)) for f in (files[:1] if quick else files)]


def training_set(library: Library, quick: bool) -> Training:
    """Return what a session trains its bases with, without the members that are held out.

    Parameters
    ----------
    library : Library
    quick : bool
        Whether to use only a third of it.
    """
    members = trained_members(library)
    kept = [library.coordinates[i] for i in members if i % HELD_OUT]
    channels = [library.embedding.decode_values(z) for z in (kept[::3] if quick else kept)]
    whole = training_tables(np.concatenate(channels, axis=1), library.embedding.grid_)
    if not quick:
        return whole
    return Training(np.ascontiguousarray(whole.tables[:, ::3]), whole.weight[::3])


def fresh_recipes(count: int, seed: int = 1) -> list[TabulatedBRDF]:
    """Return tables of materials of all families that are not in the library.

    They come from the library's recipe with another seed.

    Parameters
    ----------
    count : int
    seed : int
        Not the library's seed, 0.
    """
    grid = default_library().embedding.grid_
    # the anchors come first and are the same for every seed
    drawn = zip(materials(seed, count + 100), materials(seed + 1, count + 100), strict=True)
    new = [material for material, other in drawn if material.model != other.model][:count]
    return [TabulatedBRDF.from_model(m.model, grid, f"{m.family} {m.name}") for m in new]


def unseen(data: Path | None, quick: bool = False, seed: int = 0) -> dict[str, list[TabulatedBRDF]]:
    """Return some 200 tables (20 if quick) that no basis was fitted to, by kind.

    The kinds are: held-out library members; new members of every family; trait moves of held-out
    members, two traits at a time, with amounts up to +-2; analytic models at parameters from the
    literature; and the measured materials of ``data/rgl``. If new members cannot be made, there are
    more moves.

    Parameters
    ----------
    data : Path or None
    quick : bool
    seed : int
        Seed of the random choices.
    """
    library, space = default_library(), default_traits()
    embedding, grid = library.embedding, library.embedding.grid_
    rng = np.random.default_rng(seed)
    held = [i for i in range(len(library)) if i % HELD_OUT == 0]
    members = [library[library.names[i]] for i in rng.permutation(held)[: 4 if quick else 24]]
    recipes = fresh_recipes(4 if quick else 104)
    moves = []
    count = (8 if quick else 160) - len(recipes)
    for i in itertools.islice(itertools.cycle(rng.permutation(held)), count):
        pair = rng.choice(space.names, 2, replace=False)
        amounts = {str(name): float(rng.uniform(-2.0, 2.0)) for name in pair}
        z = library.coordinates[i]
        for name, amount in amounts.items():
            z = space.move(z, {name: amount})
        moves.append(embedding.decode(z))
    closed: list[models.Model] = [models.Lambert(1.0)]
    closed += [models.NormalizedPhong(0.5, s) for s in (5000.0, 100.0, 10.0)]
    closed += [models.TorranceSparrowSimplified(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.BoundedPhong(0.5, s) for s in (10.0, 100.0, 5000.0)]
    closed += [models.BoundedTorranceSparrow(0.5, s) for s in (0.01, 0.1, 0.2)]
    closed += [models.AshikhminShirley(0.2, 0.05, n, n) for n in (10.0, 1000.0)]
    closed += [models.GGX(a, 1.5) for a in (0.03, 0.3)]
    files = sorted((data / "rgl").glob("*.bsdf")) if data else []
    if quick:
        closed, files = closed[:5], files[:2]
    kinds = {
        "held-out library": members,
        "new recipes": recipes,
        "manifold moves": moves,
        "models": [TabulatedBRDF.from_model(m, grid, repr(m)) for m in closed],
        "measured (RGL)": [TabulatedBRDF.from_model(MeasuredBRDF.read(f), grid) for f in files],
    }
    return {kind: tables for kind, tables in kinds.items() if tables}


def channels(tables: Sequence[TabulatedBRDF]) -> Float32:
    """Return the B tables `tables` as one array (cells, 3 B): each colour channel is a column."""
    flat = [table.values.reshape(-1, 3).astype(np.float32) for table in tables]
    return np.concatenate(flat, axis=1)


MEASURED_WITHIN = math.radians(75.0)
"""Greatest angle to the normal, in radians, at which measurements are reliable."""


@dataclass(frozen=True)
class MeasuredSet:
    """Measured materials at common angles.

    Parameters
    ----------
    name : str
    angles : theta_h, theta_d, phi_d, each (n,)
        Radians.
    materials : dict of (n, 3) arrays by name
        f_r in 1/sr; negative values are invalid.
    """

    name: str
    angles: tuple[Float64, Float64, Float64]
    materials: dict[str, Float64]


def measured_sets(data: Path, n_theta_d: int = 24, n_phi_d: int = 9) -> list[MeasuredSet]:
    """Return MERL slices (phi_d 90 degrees) and RGL materials (all angles).

    Only angles within `MEASURED_WITHIN` of the normal are used.

    Parameters
    ----------
    data : Path
        Folder with merl_slices/ and rgl/.
    n_theta_d, n_phi_d : int
        Numbers of angles at which RGL materials are sampled.
    """
    theta_h = (np.arange(90) / 90) ** 2 * math.pi / 2
    h, d = np.meshgrid(theta_h, np.arange(90) / 90 * math.pi / 2, indexing="ij")
    trusted = np.cos(h) * np.cos(d) > math.cos(MEASURED_WITHIN)
    with np.load(data / "merl_slices" / "merl_phi_d_90.npz") as file:
        slices = {
            str(name): values[trusted].astype(np.float64)
            for name, values in zip(file["names"], file["values"], strict=True)
        }
    angles = h[trusted], d[trusted], np.full(trusted.sum(), math.pi / 2)
    theta_d = (np.arange(n_theta_d) + 0.5) / n_theta_d * math.pi / 2
    phi_d = (np.arange(n_phi_d) + 0.5) / n_phi_d * math.pi / 2
    th, td, pd = (a.ravel() for a in np.meshgrid(theta_h, theta_d, phi_d, indexing="ij"))
    wi, wo = from_half_diff_angles(th, td, pd)
    trusted = np.minimum(wi[:, 2], wo[:, 2]) > math.cos(MEASURED_WITHIN)
    whole = {
        path.stem: np.maximum(MeasuredBRDF.read(path).eval(wi[trusted], wo[trusted]), 0.0)
        for path in sorted((data / "rgl").glob("*.bsdf"))
    }
    everywhere = th[trusted], td[trusted], pd[trusted]
    return [MeasuredSet("MERL", angles, slices), MeasuredSet("RGL", everywhere, whole)]


def default_data() -> Path | None:
    """Return the folder of maps and measured materials: $TRAITBRDF_SHARED, or ../shared/data.

    None if neither exists.
    """
    for place in (os.environ.get("TRAITBRDF_SHARED"), "../shared/data"):
        if place and (Path(place) / "envmaps").is_dir():
            return Path(place)
    return None
