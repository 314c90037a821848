"""Mitsuba 3, an independent path tracer, with our scene, table, map and camera.

`tests/test_peers.py` checks the oracle against it, and ``traitbrdf bench peers`` compares the time
of edits with it. The two share no part of the integral: Mitsuba has its own rays and shading
frames, the table look-up is written a second time, and the rest is Monte Carlo.

Mitsuba is optional (the extra ``peers``); `load` imports it.

Mitsuba runs at its best settings: stratified samples (its ``multijitter``), map samples compensated
for material samples (``mis_compensation``), a lobe fitted to each table
(`traitbrdf.export.mitsuba.fit_lobe`), and the table in a buffer that an edit overwrites, so that no
kernel is compiled again.
"""

from __future__ import annotations

import functools
import importlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.export import mitsuba_scene
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.scene.lights import PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
VARIANT = mitsuba_scene.VARIANT

FINER = mitsuba_scene.FINER
"""Each of our texels becomes FINER x FINER texels of Mitsuba's, because its map is bilinear.

With 2 the teapot in polished gold under a photographed map is 0.1 % off, as with 8; with 1 it is
0.3 % off. Larger values only make its map slower to sample.
"""

PATHS_AT_ONCE = 1 << 23
"""Paths in one launch; they take less than 1 GB."""


@dataclass(frozen=True)
class Peer:
    """The imported Mitsuba.

    Parameters
    ----------
    mi, dr : modules mitsuba and drjit
    material : class
        The material class that `table_material` made.
    """

    mi: Any
    dr: Any
    material: Any


@functools.cache
def load() -> Peer:
    """Import Mitsuba and check that it works.

    Raises
    ------
    RuntimeError
        If it is not installed, or finds no LLVM library.
    """
    try:
        dr, mi = importlib.import_module("drjit"), importlib.import_module("mitsuba")
        mi.set_variant(VARIANT)
        mi.set_log_level(mi.LogLevel.Error)  # no message for every rounded number of samples
        dr.eval(mi.Float(1.0) + 1.0)  # this fails without the LLVM library
    except (ImportError, RuntimeError) as error:
        raise RuntimeError(
            "needs Mitsuba 3 and the LLVM library: pip install 'traitbrdf[peers]', and Debian's "
            f"libllvm19 or the like ({error})"
        ) from error
    return Peer(mi, dr, table_material(mi, dr))


# -- the material ---------------------------------------------------------------------------------


def table_material(mi: Any, dr: Any) -> Any:
    """Return a Mitsuba material class for one table on a folded grid, with two equal sides.

    It is what exported scenes have (`traitbrdf.export.mitsuba_scene`), made from a table, the
    roughness `alpha` of a GGX lobe and the share `even` of cosine-distributed directions that its
    samples are drawn from. `assign` replaces the table by another on the same grid, without
    compiling a kernel again.

    Parameters
    ----------
    mi, dr : modules mitsuba and drjit
    """

    class Table(mitsuba_scene.table_material(mi, dr)):  # type: ignore[misc]
        """A table on a folded grid as a Mitsuba material."""

        def __init__(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            super().__init__(table.values[None], alpha, even)

        def assign(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            """Replace the table: this is the edit."""
            if table.grid.layout != "folded" or table.grid.shape != self.counts:
                raise ValueError(f"table: expected a folded grid {self.counts}, got {table!r}")
            self.fill(table.values)
            self.alpha, self.even = dr.opaque(mi.Float, alpha), dr.opaque(mi.Float, even)

    return Table


# -- the scene ------------------------------------------------------------------------------------


def their_mesh(mi: Any, shape: Mesh, part: int, material: Any) -> Any:
    """Return one part of a mesh, with our normals at its corners.

    Parameters
    ----------
    mi : module mitsuba
    shape : Mesh
    part : int
        Index of the part.
    material : instance of the class that `table_material` returns
    """
    chosen = shape.face_part == part
    corners = shape.faces[chosen]
    normals = shape.normals[corners] if shape.normals.ndim == 2 else shape.normals[chosen]
    settings = mi.Properties()
    settings["material"] = material
    count = 3 * len(corners)
    mesh = mi.Mesh(shape.parts[part], count, len(corners), settings, has_vertex_normals=True)
    fields = mi.traverse(mesh)
    fields["vertex_positions"] = shape.vertices[corners].ravel().astype(np.float32)
    fields["vertex_normals"] = normals.ravel().astype(np.float32)
    fields["faces"] = np.arange(count, dtype=np.uint32)
    fields.update()
    return mesh


def their_scene(mi: Any, scene: Scene, material: Any, finer: int = FINER) -> Any:
    """Return our scene in Mitsuba, with one material for every part.

    Mitsuba's ground hides light of the map from the object; ours does not.

    Parameters
    ----------
    mi : module mitsuba
    scene : Scene
    material : instance of the class that `table_material` returns
    finer : int
        As for `traitbrdf.export.mitsuba_scene.light_map`.

    Raises
    ------
    TypeError
        If the shape is neither a sphere nor a mesh.
    """
    shape = scene.shape
    content: dict[str, Any] = {"type": "scene"}
    if scene.environment.image.any():
        content["map"] = mitsuba_scene.light_map(
            mi, scene.environment.image, scene.environment.rotation, finer
        )
    if isinstance(shape, Sphere):
        place = {"center": list(map(float, shape.center)), "radius": float(shape.radius)}
        content["sphere"] = {"type": "sphere", "material": material, **place}
    elif isinstance(shape, Mesh):
        for part, name in enumerate(shape.parts):
            content[name] = their_mesh(mi, shape, part, material)
    else:
        raise TypeError(f"shape: expected a sphere or a mesh, got {shape!r}")
    if scene.ground:
        x, _, z = shape.center
        disk = mi.ScalarTransform4f().translate([float(x), shape.lowest, float(z)])
        disk = disk.rotate([1, 0, 0], -90).scale(scene.ground * shape.radius)
        content["ground"] = {"type": "disk", "to_world": disk, "material": material}
    for i, light in enumerate(scene.lights):
        if isinstance(light, PointLight):
            level = {"type": "rgb", "value": list(light.intensity)}
            theirs = {"type": "point", "position": list(light.position), "intensity": level}
        else:
            level = {"type": "rgb", "value": list(light.irradiance)}
            away = [-c for c in light.direction]
            theirs = {"type": "directional", "direction": away, "irradiance": level}
        content[f"light{i}"] = theirs
    stands = scene.camera.position(shape, scene.height, scene.width)
    target = shape.center if scene.camera.target is None else scene.camera.target
    content["camera"] = {
        "type": "perspective",
        "fov": scene.camera.fov,
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f().look_at(
            list(map(float, stands)), list(map(float, target)), [0, 1, 0]
        ),
        "film": {
            "type": "hdrfilm",
            "width": scene.width,
            "height": scene.height,
            "rfilter": {"type": "box"},
        },
    }
    return mi.load_dict(content)


# -- the integral ---------------------------------------------------------------------------------


def integrator(mi: Any) -> Any:
    """Return an integrator for light that is scattered once.

    It is not Mitsuba's "direct", which sums the samples of point lights instead of averaging them
    (mitsuba3 issue 1861).

    Parameters
    ----------
    mi : module mitsuba
    """
    return mi.load_dict({"type": "path", "max_depth": 2})


def their_rays(peer: Peer, theirs: Any, scene: Scene, pixels: Int64, each: int) -> Any:
    """Return `each` rays through the centre of every pixel.

    Parameters
    ----------
    peer : Peer
    theirs : what `their_scene` returns
    scene : Scene
    pixels : (m,) int array
        Flat indices.
    each : int
    """
    mi, dr = peer.mi, peer.dr
    y, x = np.divmod(pixels, scene.width)
    at = np.stack([(x + 0.5) / scene.width, (y + 0.5) / scene.height], axis=-1)
    which = dr.arange(mi.UInt32, len(pixels) * each) // dr.opaque(mi.UInt32, each)
    place = dr.gather(mi.Point2f, mitsuba_scene.own(mi, dr, at.astype(np.float32)), which)
    ray, _ = theirs.sensors()[0].sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5))
    return ray


def rounded(peer: Peer, samples: int) -> int:
    """Return the samples per pixel that Mitsuba's stratified sampler makes of `samples`.

    Parameters
    ----------
    peer : Peer
    samples : int
    """
    sampler = peer.mi.load_dict({"type": "multijitter", "sample_count": samples})
    return int(sampler.sample_count())


def traced(
    peer: Peer,
    theirs: Any,
    scene: Scene,
    pixels: Int64,
    samples: int,
    seed: int,
    sampler: str = "multijitter",
) -> Float64:
    """Return Mitsuba's radiance (m, 3) of pixels, with all samples through their centres.

    Parameters
    ----------
    peer : Peer
    theirs : what `their_scene` returned for `scene`
    scene : Scene
    pixels : (m,) int array
        Flat indices.
    samples : int
        Samples per pixel, as `rounded` returns them.
    seed : int
        Seed of the random numbers; use another for each frame.
    sampler : str
        Name of Mitsuba's sampler plugin.
    """
    shots = np.array_split(pixels, math.ceil(len(pixels) * samples / PATHS_AT_ONCE))
    path = integrator(peer.mi)
    # the seed is hashed with the index in a launch, so each launch needs its own
    runs = [
        _launch(peer, theirs, path, scene, some, samples, seed * 65_536 + i, sampler)
        for i, some in enumerate(shots)
    ]
    return np.concatenate(runs)


def _launch(
    peer: Peer,
    theirs: Any,
    path: Any,
    scene: Scene,
    pixels: Int64,
    samples: int,
    seed: int,
    kind: str,
) -> Float64:
    mi, dr = peer.mi, peer.dr
    sampler = mi.load_dict({"type": kind, "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)
    sampler.seed(seed, len(pixels) * samples)
    ray = their_rays(peer, theirs, scene, pixels, samples)
    spectrum, _, _ = path.sample(theirs, sampler, ray)
    dr.eval(spectrum)  # evaluated at once: each channel alone would trace the paths again
    sums = [dr.block_sum(channel, samples) for channel in spectrum]
    return np.stack([np.array(s, np.float64) for s in sums], axis=-1) / samples
