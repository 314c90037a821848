"""Mitsuba 3, an independent path tracer, with our scene, table, map and camera.

`tests/test_peers.py` checks the oracle against it, and ``traitbrdf bench peers`` compares the time
of edits with it. The two share no part of the integral: Mitsuba has its own rays and shading
frames, the table look-up is written a second time, and the rest is Monte Carlo.

Mitsuba is optional (the extra ``peers``); `load` imports it.

Mitsuba runs at its best settings: stratified samples (its ``multijitter``), map samples compensated
for material samples (``mis_compensation``), a lobe fitted to each table (`fit_lobe`), and the table
in a buffer that an edit overwrites, so that no kernel is compiled again.
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


def _own(mi: Any, dr: Any, values: NDArray[np.float32]) -> Any:
    """Copy numbers to memory of Dr.Jit's own.

    Dr.Jit would use a NumPy array in place, and compile kernels again whenever the alignment of an
    array differs from the one before.
    """
    owned = dr.zeros(mi.Float, values.size)
    dr.scatter(owned, mi.Float(values.ravel()), dr.arange(mi.UInt32, values.size))
    dr.eval(owned)
    return owned


# -- the material ---------------------------------------------------------------------------------


def table_material(mi: Any, dr: Any) -> Any:
    """Return a Mitsuba material class for tables on a folded grid, with two equal sides.

    An instance is made from a table, the roughness `alpha` of a GGX lobe and the share `even` of
    cosine-distributed directions; its samples are drawn from these two. `assign` replaces the table
    by another on the same grid, without compiling a kernel again.

    Parameters
    ----------
    mi, dr : modules mitsuba and drjit
    """

    class Table(mi.BSDF):  # type: ignore[misc]
        """A table on a folded grid as a Mitsuba material."""

        def __init__(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            super().__init__(mi.Properties())
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_flags, self.m_components = flags, [flags]
            self.counts = table.grid.shape
            self.assign(table, alpha, even)

        def assign(self, table: TabulatedBRDF, alpha: float, even: float = 0.5) -> None:
            """Replace the table: this is the edit."""
            if table.grid.layout != "folded" or table.grid.shape != self.counts:
                raise ValueError(f"table: expected a folded grid {self.counts}, got {table!r}")
            # padded to four values per node, which are gathered at once
            padded = np.zeros((table.grid.size, 4), np.float32)
            padded[:, :3] = table.values.reshape(-1, 3)
            self.values = _own(mi, dr, padded)
            self.alpha, self.even = dr.opaque(mi.Float, alpha), dr.opaque(mi.Float, even)

        def look_up(self, light: Any, view: Any) -> Any:
            """Interpolate the table in theta_h, theta_d, phi_d (Rusinkiewicz 1998)."""
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
            """Mirror directions to the upper side, and tell whether both are above the surface."""
            side = dr.sign(view.z)
            view = mi.Vector3f(view.x, view.y, side * view.z)
            light = mi.Vector3f(light.x, light.y, side * light.z)
            return view, light, (view.z > 0) & (light.z > 0)

        def spread(self) -> Any:
            """Return the microfacet distribution that samples are drawn from."""
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return f times the cosine."""
            view, light, above = self.upright(si.wi, wo)
            return dr.select(active & above, self.look_up(light, view) * light.z, 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return the density of `sample`."""
            view, light, above = self.upright(si.wi, wo)
            half = dr.normalize(view + light)
            lobe = self.spread().pdf(view, half) / (4 * dr.dot(view, half))
            even = mi.warp.square_to_cosine_hemisphere_pdf(light)
            return dr.select(active & above, dr.lerp(lobe, even, self.even), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            """Return `eval` and `pdf`."""
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            """Draw a direction to the light from the lobe or the cosine distribution."""
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
            """Offer no parameters."""

        def to_string(self) -> str:
            """Return a short description."""
            return f"Table{self.counts}"

    return Table


def fit_lobe(table: TabulatedBRDF) -> tuple[float, float]:
    """Fit the sampling density: a GGX lobe mixed with cosine-distributed directions.

    The fit minimises the variance of samples of the table under even light.

    Parameters
    ----------
    table : TabulatedBRDF

    Returns
    -------
    alpha, even : float
        Roughness of the lobe and share of cosine-distributed directions, as for `table_material`.
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


# -- the scene ------------------------------------------------------------------------------------


def their_map(mi: Any, environment: EnvironmentMap, finer: int = FINER) -> dict[str, Any]:
    """Return a map as a Mitsuba emitter.

    Mitsuba's rows are at multiples of pi / (H - 1), its columns are centred, and u = 0.5 is +z. Its
    map is bilinear: every texel becomes `finer` x `finer` texels, and ramps remain at its edges.

    Parameters
    ----------
    mi : module mitsuba
    environment : EnvironmentMap
    finer : int
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
        As for `their_map`.

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
    place = dr.gather(mi.Point2f, _own(mi, dr, at.astype(np.float32)), which)
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
