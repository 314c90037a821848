"""Assertions about materials and frames, for your own pytest suites and pipelines.

Each raises AssertionError with a message that says where and by how much. Bad arguments raise
ValueError or TypeError, as everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf import reference
from traitbrdf.directions import from_half_diff_angles
from traitbrdf.formats.display import exposure_of
from traitbrdf.formats.files import FormatError, unknown_name
from traitbrdf.reflectance.brdf import HalfDiffGrid, Reflectance, TabulatedBRDF, albedo_of
from traitbrdf.reflectance.descriptors import cielab
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.meshes import load_mesh
from traitbrdf.space.library import default_embedding
from traitbrdf.space.traits import default_traits

if TYPE_CHECKING:
    from traitbrdf.session.editing import EditSession

__all__ = [
    "assert_frame", "assert_physical", "assert_same_look", "assert_traits", "file_faults",
]  # fmt: skip

Float64 = NDArray[np.float64]

ENERGY_ANGLES: Float64 = np.radians([0, 15, 30, 45, 55, 65, 70, 75, 80, 84, 87, 89])
"""View angles (radians) at which `assert_physical` looks at the albedo."""

_SHAPE = (45, 23, 13)  # nodes at which a BRDF is searched for holes


def assert_physical(
    brdf: Reflectance,
    energy: float = 1.01,
    angles: ArrayLike | None = None,
    reciprocity: float = 1e-3,
    seed: int = 0,
) -> None:
    """Assert that a BRDF is finite, not negative, reciprocal, keeps energy and has no holes.

    Parameters
    ----------
    brdf : Reflectance
        A table, a model or a measured material: whatever has ``eval`` and ``mirror``.
    energy : float
        Greatest directional albedo of any channel; quadrature errs by some 0.5 %.
    angles : (n,) array_like or None
        View angles in radians at which that is asked; None is `ENERGY_ANGLES`, to 89 degrees.
    reciprocity : float
        Greatest |f(wi, wo) - f(wo, wi)| relative to their sum.
    seed : int
        Of the random directions.

    Raises
    ------
    AssertionError
        The message names the first of these that fails, the angles and the value.
    """
    wi, wo = _directions(4096, seed)
    f = np.asarray(brdf.eval(wi, wo), np.float64)
    _assert_values(f, wi, wo)
    back = np.asarray(brdf.eval(wo, wi), np.float64)
    off = np.abs(f - back) / np.maximum(f + back, 1e-6)
    worst = int(off.max(axis=-1).argmax())
    if off[worst].max() > reciprocity:
        raise AssertionError(
            f"not reciprocal: f {f[worst].tolist()} and {back[worst].tolist()} with directions "
            f"swapped, at {_named(wi[worst], wo[worst])}"
        )
    for angle in ENERGY_ANGLES if angles is None else np.atleast_1d(np.asarray(angles)):
        albedo = albedo_of(brdf.eval, float(angle)) + brdf.mirror
        if albedo.max() > energy:
            raise AssertionError(
                f"more light than arrives: albedo {np.round(albedo, 4).tolist()} at "
                f"{math.degrees(float(angle)):.0f} degrees, more than {energy:g}"
            )
    _assert_no_holes(brdf)


def _directions(count: int, seed: int) -> tuple[Float64, Float64]:
    """Return random pairs of directions, half of them near each other's mirror direction."""
    rng = np.random.default_rng(seed)
    cosine, turn = rng.uniform(0.01, 1.0, (2, count)), rng.uniform(0, 2 * math.pi, (2, count))
    near = slice(0, count // 2)
    cosine[1, near] = np.clip(cosine[0, near] + rng.normal(0, 0.02, count // 2), 0.01, 1.0)
    turn[1, near] = turn[0, near] + math.pi + rng.normal(0, 0.05, count // 2)
    sine = np.sqrt(1.0 - cosine**2)
    w = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
    return w[0], w[1]


def _assert_values(f: Float64, wi: Float64, wo: Float64) -> None:
    bad = ~np.isfinite(f).all(axis=-1)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise AssertionError(
            f"not finite: f {f[i].tolist()} at {_named(wi[i], wo[i])} and {int(bad.sum()) - 1} more"
        )
    lowest = int(f.min(axis=-1).argmin())
    if f[lowest].min() < 0.0:
        raise AssertionError(
            f"negative: f {f[lowest].tolist()} at {_named(wi[lowest], wo[lowest])}"
        )


def _assert_no_holes(brdf: Reflectance) -> None:
    """Find pairs of directions well above the horizon without light, between others with some."""
    grid = HalfDiffGrid(*_SHAPE)
    wi, wo = from_half_diff_angles(*grid.node_angles())
    seen = np.minimum(wi[..., 2], wo[..., 2]) > 0.1
    f = np.zeros((*grid.shape, 3))
    f[seen] = brdf.eval(np.asarray(wi)[seen], np.asarray(wo)[seen])
    dark = seen & (f.max(axis=-1) <= 0.0)
    if not dark.any():
        return
    lit = np.pad((seen & ~dark).astype(int), 1)
    beside = sum(
        np.roll(lit, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (-1, 1)
    )
    holes = dark & (beside >= 3)
    if holes.any():
        i = np.unravel_index(int(np.flatnonzero(holes)[0]), grid.shape)
        raise AssertionError(
            f"a hole: f is 0 at {_named(np.asarray(wi)[i], np.asarray(wo)[i])}, between directions "
            f"with light; {int(holes.sum())} of {int(seen.sum())} nodes"
        )


def _named(wi: Float64, wo: Float64) -> str:
    """Return two directions in words."""
    a, b = (math.degrees(math.acos(min(float(w[2]), 1.0))) for w in (wi, wo))
    turn = math.degrees(math.atan2(wo[1], wo[0]) - math.atan2(wi[1], wi[0])) % 360.0
    return f"theta_i {a:.1f}, theta_o {b:.1f}, {turn:.0f} degrees apart"


def assert_traits(brdf: TabulatedBRDF, **ranges: tuple[float, float]) -> None:
    """Assert that scores of traits lie in ranges: ``assert_traits(brdf, shiny=(0.4, 0.8))``.

    Parameters
    ----------
    brdf : TabulatedBRDF
    **ranges : (low, high) by trait
        0 is the library's 10th percentile, 1 its 90th.

    Raises
    ------
    AssertionError
        Names every trait outside of its range, and its score.
    ValueError
        On an unknown trait, or a range that is none.
    """
    space = default_traits()
    for name, bounds in ranges.items():
        space.index(name)
        if len(bounds) != 2 or not bounds[0] <= bounds[1]:
            raise ValueError(f"{name}: expected (low, high), got {bounds!r}")
    scores = space.score(default_embedding().encode(brdf))
    off = [
        f"{name} is {scores[space.names[space.index(name)]]:.2f}, not {low:g} to {high:g}"
        for name, (low, high) in ranges.items()
        if not low <= scores[space.names[space.index(name)]] <= high
    ]
    if off:
        raise AssertionError("; ".join(off))


def assert_same_look(
    a: TabulatedBRDF,
    b: TabulatedBRDF,
    delta_e: float = 1.0,
    environment: EnvironmentMap | None = None,
    size: int = 64,
) -> None:
    """Assert that two materials look alike on a sphere.

    Parameters
    ----------
    a, b : TabulatedBRDF
        On any grids.
    delta_e : float
        Greatest CIE 1976 colour difference of 95 % of the pixels, both exposed alike.
    environment : EnvironmentMap or None
        None is the procedural sky.
    size : int
        Pixels on a side.

    Raises
    ------
    AssertionError
        Says how many pixels differ, by how much, and where most.
    """
    # imports torch, which tables do without
    from traitbrdf.pictures import spheres

    grid = default_embedding().grid_
    folded = [
        table if table.grid.layout == "folded" else TabulatedBRDF.from_model(table, grid)
        for table in (a, b)
    ]
    first, second = (spheres([table], environment, size)[0] for table in folded)
    exposure = exposure_of(first)
    labs = [cielab(np.clip(exposure * image, 0.0, 1.0)) for image in (first, second)]
    covered = first.any(axis=-1) | second.any(axis=-1)
    apart = np.where(covered, np.sqrt(((labs[0] - labs[1]) ** 2).sum(axis=-1)), 0.0)
    late = float(np.percentile(apart[covered], 95))
    if late > delta_e:
        y, x = np.unravel_index(int(apart.argmax()), apart.shape)
        share = float((apart[covered] > delta_e).mean())
        raise AssertionError(
            f"{a.name or 'the first'} and {b.name or 'the second'} differ by delta E {late:.2f} at "
            f"the 95th percentile, more than {delta_e:g}: {100 * share:.0f} % of the sphere, most "
            f"at pixel ({x}, {y}) of {size} x {size}, by {apart[y, x]:.1f}"
        )


def assert_frame(edit: EditSession, error: float = 0.01, pixels: int = 60, seed: int = 0) -> None:
    """Assert that a session's frame is right, by the reference integrator.

    Parameters
    ----------
    edit : EditSession
    error : float
        Greatest mean |I - I_ref| over mean I_ref.
    pixels : int
        Random covered pixels that are computed.
    seed : int
        Of these.

    Raises
    ------
    AssertionError
        Says the error, and where the frame is off most.
    """
    frame, scene = edit.render(), edit.scene
    covers = np.bincount(scene.pixels, minlength=scene.height * scene.width)
    alone = np.flatnonzero((covers[scene.pixels] == 1) & ~scene.bordering)
    if not len(alone):
        raise ValueError("edit: expected a view with pixels of one surface, got none")
    rng = np.random.default_rng(seed)
    chosen = rng.choice(alone, min(pixels, len(alone)), replace=False)
    y, x = np.divmod(scene.pixels[chosen], scene.width)
    exact = np.empty((len(chosen), 3))
    for i, fragment in enumerate(chosen):
        part = scene.parts[scene.pixel_part[fragment]]
        at = (x[i] + 0.5, y[i] + 0.5) if part in edit.varying else None
        exact[i] = reference.fragments(scene, [fragment], [edit.brdf(part, at=at)], 1e-3)[0][0, 0]
    off = np.abs(frame[y, x] - exact)
    found = float(off.sum() / max(exact.sum(), 1e-30))
    if found > error:
        worst = int(off.sum(axis=1).argmax())
        raise AssertionError(
            f"the frame is off by {100 * found:.2f} %, more than {100 * error:g} %: most at pixel "
            f"({x[worst]}, {y[worst]}), {frame[y[worst], x[worst]].tolist()} where it should be "
            f"{np.round(exact[worst], 4).tolist()}"
        )


def file_faults(path: str | PathLike[str], to: float = 80.0) -> list[str]:
    """Return what is wrong with a file: nothing if it can be read and is what it should be.

    Materials (.binary, .bsdf, .npz) are read and must be physical, maps (.exr, .hdr, .pic) and
    meshes (.obj, .ply, .gltf, .glb) must be read, and designs (.tbr) must load.

    Parameters
    ----------
    path : path-like
    to : float
        Greatest view angle in degrees at which energy is asked for: measurements end near 80.

    Raises
    ------
    ValueError
        On another suffix.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _CHECKS:
        raise ValueError(unknown_name("kind of file", suffix, tuple(_CHECKS)))
    try:
        found = _CHECKS[suffix](path)
        if suffix in MATERIALS:
            angles = ENERGY_ANGLES[math.radians(to) + 1e-9 >= ENERGY_ANGLES]
            assert_physical(found, angles=angles, reciprocity=0.02)
    except (FormatError, OSError, AssertionError, ValueError) as error:
        return [" ".join(str(error).removeprefix(f"{path}: ").split())]
    return []


def _design(path: str | PathLike[str]) -> object:
    # imports sessions and torch, which other files do without
    from traitbrdf.session.editing import EditSession

    return EditSession.load(path)


MATERIALS = (".binary", ".bsdf", ".npz")
"""Suffixes of files of materials."""

_CHECKS: dict[str, Callable[[Any], Any]] = {
    ".binary": TabulatedBRDF.read, ".npz": TabulatedBRDF.read, ".bsdf": MeasuredBRDF.read,
    ".tbr": _design,
    **dict.fromkeys((".exr", ".hdr", ".pic"), EnvironmentMap.read),
    **dict.fromkeys((".obj", ".ply", ".gltf", ".glb"), load_mesh),
}  # fmt: skip
