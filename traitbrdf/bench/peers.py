"""Mitsuba 3, an independent path tracer: our scene, table, map and camera as its own.

What `tests/test_peers.py` checks the oracle against, and what ``traitbrdf bench peers`` times edits
beside. Nothing of the integral is shared: it has its own rays and shading frames, the look-up of
the table is written a second time, and the rest is Monte Carlo.

The package does without Mitsuba (the extra ``peers``): it is imported when `load` is called.

It runs at the settings that suit it best: stratified samples (its ``multijitter``), the map's
samples compensated for those of the material (``mis_compensation``), a lobe fitted to each table
(`fit_lobe`), the table in a buffer that an edit overwrites, so that no kernel is compiled anew.
"""

from __future__ import annotations

import functools
import importlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.descriptors import LUMINANCE
from traitbrdf.scene.lights import EnvironmentMap, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
VARIANT = "llvm_ad_rgb"

FINER = 2
"""Into so many of its texels on a side a texel of ours is divided, since its map is bilinear.

The teapot in polished gold under a photographed map is then 0.1 % off, as with 8; with 1 it is
0.3 %. More only make its map slower to sample.
"""

_LAUNCH = 1 << 23  # paths at once: less than 1 GB


@dataclass(frozen=True)
class Peer:
    """Mitsuba as it was loaded.

    Attributes
    ----------
    mi, dr : the modules mitsuba and drjit
    material : the class that `table_material` made
    """

    mi: Any
    dr: Any
    material: Any


@functools.cache
def load() -> Peer:
    """Import Mitsuba and see that it works.

    Raises
    ------
    RuntimeError
        Where it is not installed, or finds no LLVM library.
    """
    try:
        dr, mi = importlib.import_module("drjit"), importlib.import_module("mitsuba")
        mi.set_variant(VARIANT)
        mi.set_log_level(mi.LogLevel.Error)  # it would tell of every rounded number of samples
        dr.eval(mi.Float(1.0) + 1.0)  # without the LLVM library this is what fails
    except (ImportError, RuntimeError) as error:
        raise RuntimeError(
            "needs Mitsuba 3 and the LLVM library: pip install 'traitbrdf[peers]', and Debian's "
            f"libllvm19 or the like ({error})"
        ) from error
    return Peer(mi, dr, table_material(mi, dr))


def _own(mi: Any, dr: Any, values: NDArray[np.float32]) -> Any:
    """Numbers in memory of Dr.Jit's own. It would use an array of NumPy's as it lies, and compile
    kernels anew where one is aligned and the next is not."""
    owned = dr.zeros(mi.Float, values.size)
    dr.scatter(owned, mi.Float(values.ravel()), dr.arange(mi.UInt32, values.size))
    dr.eval(owned)
    return owned


# -- the material ---------------------------------------------------------------------------------


def table_material(mi: Any, dr: Any) -> Any:
    """A class: a table on a folded grid as a Mitsuba material of two equal sides.

    Made from a table, the roughness `alpha` of a GGX lobe and the share `even` of
    cosine-distributed directions, which are what its samples are drawn from. `assign` takes others
    of the same grid without a kernel having to be compiled anew.
    """

    class Table(mi.BSDF):  # type: ignore[misc]
        def __init__(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            super().__init__(mi.Properties())
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_flags, self.m_components = flags, [flags]
            self.counts = table.grid.shape
            self.assign(table, alpha, even)

        def assign(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            """Be another table: the edit."""
            if table.grid.layout != "folded" or table.grid.shape != self.counts:
                raise ValueError(f"table: expected a folded grid {self.counts}, got {table!r}")
            # four to a node: they are gathered at once
            padded = np.zeros((table.grid.size, 4), np.float32)
            padded[:, :3] = table.values.reshape(-1, 3)
            self.values = _own(mi, dr, padded)
            self.alpha, self.even = dr.opaque(mi.Float, alpha), dr.opaque(mi.Float, even)

        def look_up(self, light: Any, view: Any) -> Any:
            """Trilinear in theta_h, theta_d, phi_d (Rusinkiewicz 1998), from the angles anew."""
            n_h, n_d, n_p = self.counts
            half = dr.normalize(light + view)
            slant = dr.hypot(half.x, half.y)
            theta_h = dr.atan2(slant, half.z)
            theta_d = dr.atan2(dr.norm(light - view), dr.norm(light + view))
            c, s = dr.select(slant > 0, half.x / slant, 1), dr.select(slant > 0, half.y / slant, 0)
            along = half.z * (c * light.x + s * light.y) - slant * light.z
            phi_d = dr.abs(dr.atan2(c * light.y - s * light.x, along))
            phi_d = dr.minimum(phi_d, math.pi - phi_d)

            def bracket(x: Any, count: int) -> tuple[Any, Any]:
                low = dr.clip(mi.Int(dr.floor(x)), 0, count - 2)
                return low, dr.clip(x - low, 0, 1)

            def node(i: Any) -> Any:
                return dr.square(mi.Float(i) / (n_h - 1)) * (0.5 * math.pi)

            i, _ = bracket(dr.sqrt(theta_h * (2 / math.pi)) * (n_h - 1), n_h)
            f_h = dr.clip((theta_h - node(i)) / (node(i + 1) - node(i)), 0, 1)
            j, f_d = bracket(theta_d * (2 / math.pi) * (n_d - 1), n_d)
            k, f_p = bracket(phi_d * (2 / math.pi) * (n_p - 1), n_p)
            total = mi.Color3f(0)
            for a, w_a in ((i, 1 - f_h), (i + 1, f_h)):
                for b, w_b in ((j, 1 - f_d), (j + 1, f_d)):
                    for e, w_e in ((k, 1 - f_p), (k + 1, f_p)):
                        value = dr.gather(mi.Vector4f, self.values, (a * n_d + b) * n_p + e)
                        total += w_a * w_b * w_e * mi.Color3f(value.x, value.y, value.z)
            return total

        def upright(self, view: Any, light: Any) -> tuple[Any, Any, Any]:
            side = dr.sign(view.z)
            view = mi.Vector3f(view.x, view.y, side * view.z)
            light = mi.Vector3f(light.x, light.y, side * light.z)
            return view, light, (view.z > 0) & (light.z > 0)

        def spread(self) -> Any:
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            view, light, above = self.upright(si.wi, wo)
            return dr.select(active & above, self.look_up(light, view) * light.z, 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            view, light, above = self.upright(si.wi, wo)
            half = dr.normalize(view + light)
            lobe = self.spread().pdf(view, half) / (4 * dr.dot(view, half))
            even = mi.warp.square_to_cosine_hemisphere_pdf(light)
            return dr.select(active & above, dr.lerp(lobe, even, self.even), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            view, _, _ = self.upright(si.wi, si.wi)
            half, _ = self.spread().sample(view, sample2)
            even = mi.warp.square_to_cosine_hemisphere(sample2)
            light = dr.select(sample1 < self.even, even, mi.reflect(view, half))
            drawn = mi.BSDFSample3f()
            drawn.wo = mi.Vector3f(light.x, light.y, dr.sign(si.wi.z) * light.z)
            drawn.eta = 1.0
            drawn.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            drawn.sampled_component = mi.UInt32(0)
            drawn.pdf = self.pdf(ctx, si, drawn.wo, active)
            value = self.eval(ctx, si, drawn.wo, active)
            return drawn, dr.select(drawn.pdf > 0, value / drawn.pdf, 0)

        def traverse(self, callback: Any) -> None:
            pass

        def to_string(self) -> str:
            return f"Table{self.counts}"

    return Table


def fit_lobe(table: TabulatedBRDF) -> tuple[float, float]:
    """The roughness of a GGX lobe and the share of cosine-distributed directions that, together,
    draw samples of a table with the least variance under even light.

    Returns
    -------
    alpha, even : float
        As `table_material` takes them.
    """
    # quadrature over half vectors, dense where lobes are narrow
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


# -- the scene ------------------------------------------------------------------------------------


def their_map(mi: Any, environment: EnvironmentMap, finer: int = FINER) -> dict[str, Any]:
    """A map as an emitter of theirs.

    Rows of theirs stand at multiples of pi / (H - 1), columns are centred; u = 0.5 is +z. Theirs
    is bilinear: every texel becomes `finer` x `finer` texels, which leaves ramps at its edges.
    """
    rows, columns, _ = environment.image.shape
    wide = environment.image.repeat(finer, axis=1)
    edge = np.arange(finer * rows + 1)
    above = np.maximum(edge - 1, 0) // finer
    below = np.minimum(edge // finer, rows - 1)
    fine = 0.5 * (wide[above] + wide[below])
    fine = np.roll(fine, finer * columns // 2, axis=1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(fine, np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], math.degrees(environment.rotation)),
        "mis_compensation": True,
    }


def their_mesh(mi: Any, shape: Mesh, part: int, material: Any) -> Any:
    """One part of a mesh, with our normals at its corners."""
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
    """Our scene in Mitsuba, every part of the one material.

    Theirs lets the ground hide light from the object; in ours it does not.

    Raises
    ------
    TypeError
        If the shape is neither a sphere nor a mesh.
    """
    shape = scene.shape
    content: dict[str, Any] = {"type": "scene"}
    if scene.environment.image.any():
        content["map"] = their_map(mi, scene.environment, finer)
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
    """Light that is scattered once.

    Not their "direct": of several samples it adds up what lamps give instead of averaging it
    (mitsuba3 issue 1861).
    """
    return mi.load_dict({"type": "path", "max_depth": 2})


def their_rays(peer: Peer, theirs: Any, scene: Scene, pixels: Int64, each: int) -> Any:
    """`each` rays through the centre of every pixel, by its flat index."""
    mi, dr = peer.mi, peer.dr
    y, x = np.divmod(pixels, scene.width)
    at = np.stack([(x + 0.5) / scene.width, (y + 0.5) / scene.height], axis=-1)
    which = dr.arange(mi.UInt32, len(pixels) * each) // dr.opaque(mi.UInt32, each)
    place = dr.gather(mi.Point2f, _own(mi, dr, at.astype(np.float32)), which)
    ray, _ = theirs.sensors()[0].sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5))
    return ray


def rounded(peer: Peer, samples: int) -> int:
    """The number of samples a pixel that their stratified sampler makes of `samples`."""
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
    """Mitsuba's radiance (m, 3) of pixels (m,), all samples through their centres.

    Parameters
    ----------
    theirs : what `their_scene` made of `scene`
    pixels : (m,) flat indices
    samples : of a pixel, as `rounded` gives them
    seed : int
        Of the random numbers: another for each frame.
    sampler : the plugin that draws them
    """
    shots = np.array_split(pixels, math.ceil(len(pixels) * samples / _LAUNCH))
    path = integrator(peer.mi)
    # a seed is hashed with the place in the launch: launches must not share one
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
    dr.eval(spectrum)  # all at once: each channel by itself would trace the paths again
    sums = [dr.block_sum(channel, samples) for channel in spectrum]
    return np.stack([np.array(s, np.float64) for s in sums], axis=-1) / samples
