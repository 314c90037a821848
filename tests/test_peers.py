"""The oracle against Mitsuba 3, an independent path tracer: same scene, same table, same light.

Nothing of the integral is shared: Mitsuba has its own camera, its own rays, its own shading
frames, a table look-up written here a second time, and Monte Carlo for the rest. Both sides send
the ray through a pixel's centre, so that fragments of one sample are compared, each against the
standard error that independent seeds show.

Beside noise the two differ by what is called `SYSTEMATIC` below. It is made of

- texels: Mitsuba's map is bilinear. Every texel becomes `FINER` x `FINER` of its texels, which
  leaves a ramp of a thirty-second of a texel at the edges;
- shadows: the oracle sees the map piece by piece. With its usual `SHADOW_CELL` pixels in the
  penumbra of the bright texel are off by 2 %, with `CELL` by some 0.1 %; finer still, they go on
  towards Mitsuba's;
- curved meshes: where light grazes, the oracle's shadow rays leave from the smooth surface,
  Mitsuba's from the triangles. That moves the mean of teapot(8) by 0.12 %, of teapot(24) by no
  more than 0.04 %.
"""

from __future__ import annotations

import functools
import math
import os
from types import SimpleNamespace

import numpy as np
import pytest

from traitbrdf import reference
from traitbrdf.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.models import GGX, Lambert
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import Mesh, Sphere, sphere, teapot

pytestmark = pytest.mark.slow

FINER = 32
CELL = 0.006
SYSTEMATIC = 1e-3  # of a fragment's radiance
SEEDS = 32
GRID = HalfDiffGrid(60, 30, 19)
MODELS = {
    "lambert": (Lambert((0.8, 0.5, 0.2)), 0.5),
    "glossy": (GGX(alpha=0.2) + Lambert((0.1, 0.2, 0.4)), 0.2),
    "metal": (GGX(alpha=0.1, k_s=(1.0, 0.8, 0.3)), 0.1),
}
"""Models to tabulate, and the roughness by which Mitsuba places its samples."""


@functools.cache
def load_peer():
    """Mitsuba, Dr.Jit and our table as a material of theirs; or why there are none."""
    try:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.eval(mitsuba.Float(1.0) + 1.0)  # without the LLVM library this is what fails
    except (ImportError, RuntimeError) as error:
        return f"needs Mitsuba 3 and the LLVM library (the extra 'peers'): {error}"
    return SimpleNamespace(mi=mitsuba, dr=drjit, material=table_material(mitsuba, drjit))


@pytest.fixture
def peer():
    """Skips without Mitsuba, save where CI=true: there the check must not vanish unseen."""
    found = load_peer()
    if isinstance(found, str):
        if os.environ.get("CI") == "true":
            pytest.fail(found)
        pytest.skip(found)
    return found


def table_material(mi, dr):
    """A class: a table on a folded grid as a Mitsuba material of two equal sides."""

    class Table(mi.BSDF):
        def __init__(self, table, alpha):
            super().__init__(mi.Properties())
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_flags, self.m_components = flags, [flags]
            self.counts = table.grid.shape
            self.values = mi.Float(table.values.astype(np.float32).ravel())
            self.spread = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, False)

        def look_up(self, light, view):
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

            def bracket(x, count):
                low = dr.clip(mi.Int(dr.floor(x)), 0, count - 2)
                return low, dr.clip(x - low, 0, 1)

            def node(i):
                return dr.square(mi.Float(i) / (n_h - 1)) * (0.5 * math.pi)

            i, _ = bracket(dr.sqrt(theta_h * (2 / math.pi)) * (n_h - 1), n_h)
            f_h = dr.clip((theta_h - node(i)) / (node(i + 1) - node(i)), 0, 1)
            j, f_d = bracket(theta_d * (2 / math.pi) * (n_d - 1), n_d)
            k, f_p = bracket(phi_d * (2 / math.pi) * (n_p - 1), n_p)
            total = mi.Color3f(0)
            for a, w_a in ((i, 1 - f_h), (i + 1, f_h)):
                for b, w_b in ((j, 1 - f_d), (j + 1, f_d)):
                    for e, w_e in ((k, 1 - f_p), (k + 1, f_p)):
                        value = dr.gather(mi.Color3f, self.values, (a * n_d + b) * n_p + e)
                        total += w_a * w_b * w_e * value
            return total

        def upright(self, view, light):
            side = dr.sign(view.z)
            view = mi.Vector3f(view.x, view.y, side * view.z)
            light = mi.Vector3f(light.x, light.y, side * light.z)
            return view, light, (view.z > 0) & (light.z > 0)

        def eval(self, ctx, si, wo, active=True):
            view, light, above = self.upright(si.wi, wo)
            return dr.select(active & above, self.look_up(light, view) * light.z, 0)

        def pdf(self, ctx, si, wo, active=True):
            view, light, above = self.upright(si.wi, wo)
            half = dr.normalize(view + light)
            lobe = self.spread.pdf(view, half) / (4 * dr.dot(view, half))
            even = mi.warp.square_to_cosine_hemisphere_pdf(light)
            return dr.select(active & above, 0.5 * (lobe + even), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            view, _, _ = self.upright(si.wi, si.wi)
            half, _ = self.spread.sample(view, sample2)
            even = mi.warp.square_to_cosine_hemisphere(sample2)
            light = dr.select(sample1 < 0.5, even, mi.reflect(view, half))
            drawn = mi.BSDFSample3f()
            drawn.wo = mi.Vector3f(light.x, light.y, dr.sign(si.wi.z) * light.z)
            drawn.eta = 1.0
            drawn.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            drawn.sampled_component = mi.UInt32(0)
            drawn.pdf = self.pdf(ctx, si, drawn.wo, active)
            value = self.eval(ctx, si, drawn.wo, active)
            return drawn, dr.select(drawn.pdf > 0, value / drawn.pdf, 0)

        def traverse(self, callback):
            pass

        def to_string(self):
            return f"Table{self.counts}"

    return Table


def their_map(mi, environment):
    """Rows of theirs stand at multiples of pi / (H - 1), columns are centred; u = 0.5 is +z."""
    rows, columns, _ = environment.image.shape
    wide = environment.image.repeat(FINER, axis=1)
    edge = np.arange(FINER * rows + 1)
    above = np.maximum(edge - 1, 0) // FINER
    below = np.minimum(edge // FINER, rows - 1)
    fine = 0.5 * (wide[above] + wide[below])
    fine = np.roll(fine, FINER * columns // 2, axis=1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(fine, np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], math.degrees(environment.rotation)),
    }


def their_mesh(mi, shape, part, material):
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


def their_scene(mi, scene, material):
    """Our scene in Mitsuba, every part of the one material."""
    shape = scene.shape
    content = {"type": "scene"}
    if scene.environment.image.any():
        content["map"] = their_map(mi, scene.environment)
    if isinstance(shape, Sphere):
        place = {"center": list(map(float, shape.center)), "radius": float(shape.radius)}
        content["sphere"] = {"type": "sphere", "material": material, **place}
    else:
        for part, name in enumerate(shape.parts):
            content[name] = their_mesh(mi, shape, part, material)
    if scene.ground:
        x, _, z = shape.center
        place = mi.ScalarTransform4f().translate([float(x), shape.lowest, float(z)])
        place = place.rotate([1, 0, 0], -90).scale(scene.ground * shape.radius)
        content["ground"] = {"type": "disk", "to_world": place, "material": material}
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


def their_rays(peer, theirs, scene, index, each):
    """`each` rays through the centre of every fragment's pixel."""
    mi, dr = peer.mi, peer.dr
    y, x = np.divmod(scene.pixels[index], scene.width)
    at = np.stack([(x + 0.5) / scene.width, (y + 0.5) / scene.height]).astype(np.float32)
    which = dr.arange(mi.UInt32, len(index) * each) // each
    place = dr.gather(mi.Point2f, mi.Point2f(at), which)
    ray, _ = theirs.sensors()[0].sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5))
    return ray


def integrator(mi):
    """Light that is scattered once.

    Not their "direct": of several samples it adds up what lamps give instead of averaging it
    (mitsuba3 issue 1861).
    """
    return mi.load_dict({"type": "path", "max_depth": 2})


def path_traced(peer, scene, index, table, alpha, samples):
    """Mitsuba's radiance of fragments: mean and its standard error, (m, 3) each."""
    mi = peer.mi
    theirs = their_scene(mi, scene, peer.material(table, alpha))
    direct_light = integrator(mi)
    runs = []
    for seed in range(SEEDS):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, len(index) * samples)
        ray = their_rays(peer, theirs, scene, index, samples)
        spectrum, _, _ = direct_light.sample(theirs, sampler, ray)
        runs.append(np.array(spectrum, np.float64).T.reshape(len(index), samples, 3).mean(axis=1))
    return np.mean(runs, axis=0), np.std(runs, axis=0, ddof=1) / math.sqrt(SEEDS)


def inner_fragments(scene, count, part=None):
    """Random fragments of one sample, not seen at a grazing angle."""
    index = np.flatnonzero(~scene.bordering)
    first = scene.offsets[index]
    index = index[np.sum(scene.normals[first] * scene.views[first], axis=-1) > 0.15]
    if part is not None:
        index = index[scene.pixel_part[index] == scene.parts.index(part)]
    return np.sort(np.random.default_rng(0).permutation(index)[:count])


def bright_map(rows=16):
    """Noise with a dim lower half, and one texel that gives half of all light."""
    image = 0.2 + np.random.default_rng(0).random((rows, 2 * rows, 3))
    image[rows // 2 :] *= 0.3
    image[rows // 4, 9] = (300.0, 280.0, 240.0)
    return EnvironmentMap(image, 0.3)


def boxes():
    """Two boxes on a floor, every face flat: no shading normals but the triangles' own.

    They lean, or the edges of their shadows would run along the columns of the map: the pieces
    that an edge cuts would then all be wrong to the same side.
    """
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    unit = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), -1)
    quads = [np.array([[-3.0, 0.0, -2.0], [-3.0, 0.0, 3.0], [3.0, 0.0, 3.0], [3.0, 0.0, -2.0]])]
    c, s = math.cos(0.25), math.sin(0.25)
    lean = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    for size, turn, x, z in (((1.2, 2.0, 1.2), 0.4, -1.0, 0.0), ((1.0, 1.0, 1.0), -0.3, 1.0, 0.5)):
        c, s = math.cos(turn), math.sin(turn)
        corners = (unit.reshape(-1, 3) - (0.5, 0.1, 0.5)) * size @ lean
        corners = corners @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) + (x, 0.0, z)
        quads += [corners[face] for face in faces]
    normals = [np.cross(q[1] - q[0], q[2] - q[0]) for q in quads]
    first = 4 * np.arange(len(quads))[:, None]
    return Mesh(
        np.concatenate(quads),
        np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]),
        np.repeat(normals, 4, axis=0),
        np.tile([0] + [1] * 6 + [2] * 6, 2),
        ("floor", "tall", "low"),
    )


LAMPS = (
    PointLight((2.0, 3.0, 3.0), (6.0, 5.0, 4.0)),
    DirectionalLight((-1.0, 2.0, 1.0), (0.8, 0.7, 0.9)),
)


def make_scene(name):
    near, wide = Camera.orbit(35.0, 25.0, zoom=1.2), Camera.orbit(35.0, 25.0, zoom=0.6)
    if name == "boxes":
        return Scene(boxes(), bright_map(), camera=near, size=(40, 48))
    if name == "sphere":
        return Scene(sphere(1.1, (0.1, 0.2, 0.3)), bright_map(), LAMPS, near, size=48)
    if name == "ground":
        return Scene(sphere(), bright_map(), LAMPS, wide, size=48, ground=True)
    return Scene(teapot(24), bright_map(), LAMPS, near, size=64)


# ---------------------------------------------------------------------------------------------
# what must be the same before radiance can be


def test_tables_are_looked_up_alike(peer):
    table = TabulatedBRDF.from_model(MODELS["metal"][0] + Lambert(0.1), GRID)
    w = np.random.default_rng(0).normal(size=(2, 10_000, 3))
    w[..., 2] = np.abs(w[..., 2])
    w /= np.linalg.norm(w, axis=-1, keepdims=True)
    light, view = (peer.mi.Vector3f(d.T.astype(np.float32)) for d in w)
    theirs = np.array(peer.material(table, 0.1).look_up(light, view)).T
    np.testing.assert_allclose(theirs, table.eval(w[0], w[1]), rtol=1e-4, atol=1e-5)


def test_maps_are_turned_alike(peer):
    mi, dr = peer.mi, peer.dr
    environment = bright_map()
    w = np.random.default_rng(1).normal(size=(5_000, 3))
    w /= np.linalg.norm(w, axis=-1, keepdims=True)
    emitter = mi.load_dict(their_map(mi, environment))
    seen = dr.zeros(mi.SurfaceInteraction3f, len(w))
    seen.wi = mi.Vector3f(-w.T.astype(np.float32))
    theirs, ours = np.array(emitter.eval(seen)).T, environment.radiance(w)
    # all but the ramps: 1/32 of a texel at either side of its four edges
    same = np.all(np.abs(theirs - ours) <= 1e-4 * ours, axis=-1)
    assert np.mean(same) > 0.85
    sun = environment.image.max()
    assert np.count_nonzero(same & (ours[:, 0] == sun)) > 5


@pytest.mark.parametrize("name", ["boxes", "sphere", "ground", "teapot"])
def test_cameras_see_alike(peer, name):
    scene = make_scene(name)
    index = inner_fragments(scene, 500)
    theirs = their_scene(
        peer.mi, scene, peer.material(TabulatedBRDF.from_model(Lambert(), GRID), 1)
    )
    hit = theirs.ray_intersect(their_rays(peer, theirs, scene, index, 1))
    first = scene.offsets[index]
    np.testing.assert_allclose(np.array(hit.p).T, scene.positions[first], atol=2e-5)
    normal = np.array(hit.sh_frame.n).T
    facing = np.sign(np.sum(normal * scene.views[first], axis=-1, keepdims=True))
    np.testing.assert_allclose(facing * normal, scene.normals[first], atol=2e-5)


# ---------------------------------------------------------------------------------------------
# radiance


@pytest.mark.parametrize("name", ["boxes", "sphere", "ground", "teapot"])
def test_radiance_is_theirs(peer, name):
    """Of the ground only its own fragments: in our scenes it hides no light from the sphere."""
    scene = make_scene(name)
    index = inner_fragments(scene, 32, "ground" if name == "ground" else None)
    assert len(index) == 32
    tables = [TabulatedBRDF.from_model(model, GRID) for model, _ in MODELS.values()]
    values, _ = reference.fragments(scene, index, tables, shadow_cell=CELL)
    for b, (_, alpha) in enumerate(MODELS.values()):
        mean, deviation = path_traced(peer, scene, index, tables[b], alpha, 4096)
        ours = values[:, b]
        expected = np.hypot(deviation, SYSTEMATIC * ours)
        z = (mean - ours) / expected
        # one figure for the three colours: they share their rays and so their noise
        signed = np.mean(mean - ours)
        spread = math.sqrt(np.sum(expected.mean(axis=-1) ** 2)) / len(index)
        assert abs(signed) < 4.0 * spread
        assert abs(signed) < 0.005 * np.mean(ours)
        assert math.sqrt(np.mean(z**2)) < 1.3


@pytest.mark.parametrize("name", ["boxes", "teapot"])
def test_borders_are_theirs(peer, name):
    """The mean over whole pixels at edges, of parts and of shadows alike; lit by one lamp alone.

    64 samples a pixel place an edge to some 1 % of the pixel, and the edges' errors average out.
    """
    dark = EnvironmentMap(np.zeros((2, 4, 3)))
    shape = boxes() if name == "boxes" else teapot(24)
    camera = Camera.orbit(35.0, 25.0)
    scene = Scene(shape, dark, LAMPS[1:], camera, size=(24, 30), subsamples=64)
    model, alpha = MODELS["glossy"]
    table = TabulatedBRDF.from_model(model, GRID)
    theirs = their_scene(peer.mi, scene, peer.material(table, alpha))
    shown = np.array(peer.mi.render(theirs, integrator=integrator(peer.mi), spp=8192), np.float64)
    at_border = np.unique(scene.pixels[scene.bordering])
    assert len(at_border) > 100
    ours = reference.render(scene, table).reshape(-1, 3)[at_border]
    difference = shown.reshape(-1, 3)[at_border] - ours
    assert abs(np.mean(difference)) < 0.005 * np.mean(ours)
    assert np.mean(np.abs(difference)) < 0.025 * np.mean(ours)
