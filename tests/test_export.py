"""Exported designs: fits, glTF, OpenPBR, Mitsuba scenes, textures of local paint, refusals."""

from __future__ import annotations

import functools
import http.server
import importlib.util
import io
import json
import os
import struct
import subprocess
import threading
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from chrome import CHROMIUM, WEBGL
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import traitbrdf as tb
from traitbrdf.export.baking import as_values, columns, of_values
from traitbrdf.export.fitting import error_of, fit
from traitbrdf.export.gltf import GltfLook, GltfTarget, thin_film
from traitbrdf.export.lobes import (
    PicturePixels,
    fitting_pixels,
    fuzz_albedo,
    fuzz_lobe,
    ggx_albedo,
    hemisphere,
    sheen_albedo,
)
from traitbrdf.export.openpbr import OpenPBRTarget
from traitbrdf.export.pieces import pieces_of, unwrapped
from traitbrdf.formats.images import write_exr
from traitbrdf.reflectance.models import ggx_lobe
from traitbrdf.scene.shapes import Mesh

ROOT = Path(__file__).resolve().parents[1]
NODE = ROOT / ".venv" / "npm" / "node_modules"
TARGETS = [GltfTarget(), OpenPBRTarget()]
named = pytest.mark.parametrize("target", TARGETS, ids=["gltf", "openpbr"])


@pytest.fixture(scope="session")
def pixels():
    return fitting_pixels(tb.default_embedding().grid_)


def image_of(pixels, brdf):
    table = tb.TabulatedBRDF.from_model(brdf, pixels.grid)
    return pixels.of_table(table.values.reshape(-1, 3), np.asarray(table.mirror))


class Core:
    """The core model of glTF 2.0, a second time: appendix B with Schlick's term."""

    mirror = np.zeros(3)

    def __init__(self, look: GltfLook) -> None:
        self.look = look

    def eval(self, wi, wo):
        look, wi, wo = self.look, np.asarray(wi), np.asarray(wo)
        half = wi + wo
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        grazing = (1.0 - np.clip((half * wo).sum(-1), 0, 1))[..., None] ** 5
        a2 = look.roughness**4
        nh, nl, nv = half[..., 2], wi[..., 2], wo[..., 2]
        d = a2 / (np.pi * (nh * nh * (a2 - 1) + 1) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            v = 0.5 / (
                nl * np.sqrt(nv * nv * (1 - a2) + a2) + nv * np.sqrt(nl * nl * (1 - a2) + a2)
            )
        lobe = np.where((nl > 0) & (nv > 0), d * v, 0.0)[..., None]
        base, f0 = np.array(look.base_color), np.array(look.f0)
        fresnel = look.specular * (f0 + (1 - f0) * grazing)
        plastic = base / np.pi * (1 - fresnel.max(-1, keepdims=True)) + fresnel * lobe
        metal = (base + (1 - base) * grazing) * lobe
        value = look.metallic * metal + (1 - look.metallic) * plastic
        return np.where(((nl > 0) & (nv > 0))[..., None], value, 0.0)


# -- lobes and fits -------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.4, 0.7, 1.0])
def test_albedos_are_the_integrals_of_their_lobes(alpha):
    cosine = np.array([0.2, 0.6, 1.0])
    found = ggx_albedo(cosine, alpha).sum(axis=1)
    lobe = hemisphere(cosine, lambda wi, wo: ggx_lobe(wi, wo, alpha))
    assert np.allclose(found, lobe, atol=0.01)
    assert (found <= 1.0 + 1e-6).all()
    assert (sheen_albedo(cosine, max(alpha, 0.25)) <= 1.0).all()
    fuzz = hemisphere(cosine, lambda wi, wo: fuzz_lobe(wi, wo, alpha))
    assert np.allclose(fuzz, fuzz_albedo(cosine, alpha), atol=0.01)


@pytest.mark.parametrize(
    "look",
    [
        GltfLook((0.5, 0.2, 0.1), 0.0, 0.6),
        GltfLook((0.9, 0.6, 0.3), 1.0, 0.35),
        GltfLook((0.1, 0.2, 0.6), 0.0, 0.3, (0.08, 0.05, 0.03), 0.7),
        GltfLook((0.4, 0.4, 0.4), 0.4, 0.5),
    ],
    ids=["plastic", "metal", "tinted", "between"],
)
def test_the_image_is_that_of_the_specifications_model(pixels, look):
    seen = image_of(pixels, Core(look))
    assert error_of(GltfTarget(), look, pixels, seen) < 0.01


@named
@pytest.mark.parametrize("albedo", [0.0, 0.18, 0.9])
def test_lambert_is_found_again(pixels, target, albedo):
    seen = image_of(pixels, tb.models.Lambert((albedo, 0.5 * albedo, 0.2)))
    found = fit(target, pixels, seen)
    assert found.error < 0.02
    assert np.allclose(found.look.base_color, (albedo, 0.5 * albedo, 0.2), atol=0.03)


def test_a_rough_metal_is_found_again(pixels):
    truth = GltfLook((0.95, 0.6, 0.35), 1.0, 0.4)
    found = fit(GltfTarget(), pixels, image_of(pixels, Core(truth)))
    assert found.error < 0.01
    assert abs(found.look.roughness - 0.4) < 0.02


@named
@pytest.mark.parametrize("name", ["black-plastic", "gold-polished", "red-rubber", "white-plastic"])
def test_library_materials_are_fitted(pixels, target, name):
    table = tb.default_library()[name]
    seen = pixels.of_table(table.values.reshape(-1, 3), np.asarray(table.mirror))
    found = fit(target, pixels, seen)
    assert found.error < 0.06
    values = as_values(found.look)
    assert np.isfinite(values).all()
    assert values.min() >= 0.0
    # near the answer a few steps are enough
    again = fit(target, pixels, seen, [found.vector])
    assert again.error < 1.2 * found.error + 0.002


@named
def test_nothing_reflects_nothing(pixels, target):
    found = fit(target, pixels, np.zeros((len(pixels.cosine), 3)))
    assert np.isfinite(as_values(found.look)).all()
    assert target.image(found.look, pixels).max() < 0.05


def test_pictures_and_pixels_agree(pixels):
    grid = pixels.grid
    picture = PicturePixels(grid, tb.EnvironmentMap.uniform(1.0), 24)
    white = tb.TabulatedBRDF.from_model(tb.models.Lambert(1.0), grid)
    values, mirror = white.values.reshape(-1, 3), np.asarray(white.mirror)
    image = picture.picture(lambda p: p.of_table(values, mirror))
    assert np.allclose(image[image > 0], 1.0, atol=2e-3)  # a furnace
    look = GltfLook((1.0, 1.0, 1.0), 0.0, 1.0, (0.0, 0.0, 0.0), 0.0)
    other = picture.picture(lambda p: GltfTarget().image(look, p))
    assert np.allclose(other[image > 0], 1.0, atol=2e-3)


def test_looks_and_numbers_round_trip():
    look = GltfLook((0.1, 0.2, 0.3), 0.4, 0.5, (0.6, 0.7, 0.8), 0.9)
    values = as_values(look)
    assert of_values(look, values) == look
    assert columns(look)["f0"] == slice(5, 8)


@pytest.mark.parametrize("f0", [0.0, 0.02, 0.04, 0.17, 0.9, 1.0])
def test_index_and_tint_say_the_reflection(f0):
    look = GltfLook((0.5, 0.5, 0.5), 0.0, 0.5, (f0, 0.5 * f0, 0.0))
    told = ((look.ior - 1) / (look.ior + 1)) ** 2 * np.array(look.specular_color)
    assert np.allclose(told, look.f0, atol=1e-6)
    assert 1.0 <= look.ior <= 2.5


# -- geometry -------------------------------------------------------------------------------------


def test_the_pieces_are_the_scene():
    scene = tb.Scene(tb.teapot(), ground=2.0, size=16)
    pieces = {piece.name: piece for piece in pieces_of(scene)}
    assert tuple(pieces) == scene.parts
    shape = scene.shape
    for i, name in enumerate(shape.parts):
        piece = pieces[name]
        corner = piece.positions[piece.faces]
        area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        theirs = shape.vertices[shape.faces[shape.face_part == i]]
        ours = np.cross(theirs[:, 1] - theirs[:, 0], theirs[:, 2] - theirs[:, 0])
        assert np.linalg.norm(area, axis=1).sum() == pytest.approx(
            np.linalg.norm(ours, axis=1).sum()
        )
        # wound as the normals say
        assert ((area * piece.normals[piece.faces].sum(1)).sum(1) > 0.0).mean() > 0.99
    assert np.allclose(pieces["ground"].positions[:, 1], shape.lowest)


@pytest.mark.parametrize("shape", [tb.sphere(2.0, (1.0, 2.0, 3.0)), tb.teapot()], ids=repr)
def test_texels_lie_on_the_surface(shape):
    scene = tb.Scene(shape, size=16)
    for piece in pieces_of(scene)[:2]:
        made, texels = unwrapped(piece, 64)
        assert 0.1 * 64**2 < len(texels.place) <= 64**2
        assert np.allclose(np.linalg.norm(texels.normals, axis=1), 1.0)
        assert made.uvs is not None
        assert made.uvs.min() >= 0.0
        assert made.uvs.max() <= 1.0
        low, high = piece.positions.min(0) - 1e-6, piece.positions.max(0) + 1e-6
        assert ((texels.positions >= low) & (texels.positions <= high)).all()
        if isinstance(shape, type(tb.sphere())):
            away = np.linalg.norm(texels.positions - shape.center, axis=1)
            assert np.allclose(away, shape.radius, rtol=3e-3)
        everywhere = texels.spread(texels.positions)
        assert np.isfinite(everywhere).all()
        flat = everywhere.reshape(-1, 3)
        assert np.array_equal(flat[texels.place], texels.positions)


def test_overlapping_coordinates_are_made_anew():
    # two triangles that share their texture
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1.0]])
    uvs = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]] * 2)
    normals = np.broadcast_to((0.0, 0.0, 1.0), corners.shape)
    shape = Mesh(corners, [[0, 1, 2], [3, 4, 5]], normals, [0, 0], ["both"], uvs)
    piece = pieces_of(tb.Scene(shape, size=8))[0]
    made, texels = unwrapped(piece, 64)
    assert np.unique(np.round(texels.positions[:, 2], 6)).tolist() == [0.0, 1.0]
    assert not np.array_equal(made.uvs, piece.uvs)
    one = Mesh(corners[:3], [[0, 1, 2]], normals[:3], [0], ["one"], uvs[:3])
    kept = pieces_of(tb.Scene(one, size=8))[0]
    assert unwrapped(kept, 64)[0] is kept


# -- glTF -----------------------------------------------------------------------------------------


def chunks(path: Path) -> tuple[dict, bytes]:
    """The JSON and the binary chunk of a .glb file, by a few lines of their own."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON"
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def image_in(path: Path, index: int) -> np.ndarray:
    said, binary = chunks(path)
    view = said["bufferViews"][said["images"][said["textures"][index]["source"]]["bufferView"]]
    start = view["byteOffset"]
    return np.asarray(Image.open(io.BytesIO(binary[start : start + view["byteLength"]])))


@pytest.fixture(scope="module")
def painted():
    scene = tb.Scene(
        tb.teapot(), lights=[tb.PointLight((2, 3, 2)), tb.DirectionalLight((0, -1, 0.2))], size=64
    )
    edit = tb.EditSession(scene)
    edit.assign(scene.shape.parts, "red-rubber")
    edit.assign("lid", "gold-polished")
    line = tb.Stroke([(22, 36), (40, 36)], radius=7)
    edit.paint(line, tb.Move(shiny=0.6), where="local")
    return edit


@pytest.fixture(scope="module")
def files(painted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    return {
        kind: painted.export(folder / f"pot.{kind}", texture_size=128)
        for kind in ("glb", "mtlx", "py")
    }


def test_glb_has_the_geometry(painted, files):
    path = files["glb"].files[0]
    shape = painted.scene.shape
    theirs = trimesh.load(path)
    assert set(theirs.geometry) == set(shape.parts)
    assert theirs.area == pytest.approx(trimesh.Trimesh(shape.vertices, shape.faces).area, rel=1e-5)
    ours = tb.load_mesh(path)
    assert set(ours.parts) == set(shape.parts)
    assert len(ours.faces) == len(shape.faces)
    assert np.allclose(ours.center, shape.center, atol=1e-5)
    assert ours.radius == pytest.approx(shape.radius, rel=1e-5)


def test_glb_opens_in_another_loader(painted, files):
    read = pygltflib.GLTF2().load(str(files["glb"].files[0]))
    blob, total = read.binary_blob(), 0.0

    def array(index, kind, width):
        one = read.accessors[index]
        start = read.bufferViews[one.bufferView].byteOffset + (one.byteOffset or 0)
        return np.frombuffer(blob, kind, one.count * width, start).reshape(-1, width)

    for mesh in read.meshes:
        (only,) = mesh.primitives
        points = array(only.attributes.POSITION, "<f4", 3)
        points = points[array(only.indices, "<u4", 1).reshape(-1, 3)]
        sides = points[:, 1:].astype(float) - points[:, :1]
        total += 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()
        assert read.materials[only.material].name == mesh.name
    assert tuple(mesh.name for mesh in read.meshes) == painted.scene.shape.parts
    shape = painted.scene.shape
    area = trimesh.Trimesh(shape.vertices, shape.faces).area
    assert total == pytest.approx(area, rel=1e-5)


def test_glb_says_camera_and_lights(painted, files):
    said, _ = chunks(files["glb"].files[0])
    camera, scene = said["cameras"][0]["perspective"], painted.scene
    assert camera["yfov"] == pytest.approx(np.radians(scene.camera.fov))
    node = next(node for node in said["nodes"] if "camera" in node)
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    eye = scene.camera.position(scene.shape, 64, 64)
    assert np.allclose(matrix[:3, 3], eye)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3))
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    middle = scene.camera.through(64, 64, np.array(32.0), np.array(32.0))
    assert np.allclose(matrix[:3, 2], -middle)
    lights = said["extensions"]["KHR_lights_punctual"]["lights"]
    assert [light["type"] for light in lights] == ["point", "directional"]
    turn = next(n["rotation"] for n in said["nodes"] if "rotation" in n)
    x, y, z, w = turn
    # where +z goes
    toward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert np.allclose(toward, scene.lights[1].direction)


def test_glb_materials_are_within_their_ranges(files):
    said, _ = chunks(files["glb"].files[0])
    used = set(said["extensionsUsed"])
    for material in said["materials"]:
        core, more = material["pbrMetallicRoughness"], material["extensions"]
        assert set(more) <= used
        assert all(0.0 <= channel <= 1.0 for channel in core["baseColorFactor"])
        assert 0.0 <= core["metallicFactor"] <= 1.0
        assert 0.0 <= core["roughnessFactor"] <= 1.0
        assert 0.0 <= more["KHR_materials_specular"]["specularFactor"] <= 1.0
        assert min(more["KHR_materials_specular"]["specularColorFactor"]) >= 0.0
        assert ("baseColorTexture" in core) == (material["name"] == "body")
    lid = next(m for m in said["materials"] if m["name"] == "lid")
    assert lid["pbrMetallicRoughness"]["metallicFactor"] > 0.9
    assert max(files["glb"].errors.values()) < 0.05


def test_textures_vary_where_it_is_painted_and_nowhere_else(painted, files):
    path = files["glb"].files[0]
    said, _ = chunks(path)
    body = next(m for m in said["materials"] if m["name"] == "body")["pbrMetallicRoughness"]
    rough = image_in(path, body["metallicRoughnessTexture"]["index"])[..., 1].astype(int)
    assert rough.shape == (128, 128)
    plain = np.bincount(rough.ravel()).argmax()
    assert (rough == plain).mean() > 0.5
    assert plain - rough.min() > 25  # shinier under the stroke
    # what is not painted is what the rim, of the same rubber, has throughout
    rim = next(m for m in said["materials"] if m["name"] == "rim")["pbrMetallicRoughness"]
    assert abs(plain / 255 - rim["roughnessFactor"]) < 0.005


def test_a_picture_compares_tables_and_fits(files):
    picture = files["glb"].picture(tb.EnvironmentMap.sky(), 32)
    assert picture.shape == (64, 6 * 32, 3)
    with pytest.raises(ValueError, match="tables"):
        files["py"].picture(tb.EnvironmentMap.sky())


def need_node(package: str) -> None:
    if not (NODE / package).exists():
        reason = f"no {package} in {NODE}; make browser installs it"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)


@pytest.mark.slow
def test_the_khronos_validator_finds_nothing(files, tmp_path):
    need_node("gltf-validator")
    cube = tb.EditSession(tb.Scene(tb.sphere(), size=16, ground=True))
    cube.paint(tb.Stroke([(8, 8)], radius=4), tb.Move(shiny=0.5), where="local")
    ball = cube.export(tmp_path / "ball.glb", texture_size=32).files[0]
    program = (
        f"const v=require({str(NODE / 'gltf-validator')!r}),fs=require('fs');"
        "Promise.all(process.argv.slice(1).map(f=>v.validateBytes(new Uint8Array("
        "fs.readFileSync(f))))).then(all=>console.log(JSON.stringify(all.map(r=>r.issues))))"
    )
    paths = [str(files["glb"].files[0]), str(ball)]
    run = subprocess.run(
        ["node", "-e", program, *paths], capture_output=True, text=True, check=True
    )
    for issues in json.loads(run.stdout):
        # texture coordinates of parts without textures are kept, and that is no fault
        assert {one["code"] for one in issues["messages"]} <= {"UNUSED_OBJECT"}
        assert issues["numErrors"] == issues["numWarnings"] == 0


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without a line for each."""

    def log_message(self, *_args: object) -> None:
        pass


PAGE = """<!doctype html><body style="margin:0"><script type="importmap">{"imports": {
"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module">
import * as T from 'three';
import {GLTFLoader} from 'three/addons/loaders/GLTFLoader.js';
import {EXRLoader} from 'three/addons/loaders/EXRLoader.js';
const renderer = new T.WebGLRenderer();
const scene = new T.Scene(), file = new URLSearchParams(location.search).get('file');
const map = await new EXRLoader().setDataType(T.FloatType).loadAsync('/map.exr');
map.mapping = T.EquirectangularReflectionMapping;
scene.environment = map; scene.environmentRotation.y = Math.PI / 2;
const gltf = await new GLTFLoader().loadAsync(file);
scene.add(gltf.scene);
const target = new T.WebGLRenderTarget(128, 128, {type: T.FloatType, samples: 4});
renderer.setRenderTarget(target);
renderer.render(scene, gltf.cameras[0]);
window.pixels = new Float32Array(4 * 128 * 128);  // of linear light; 8 bits would round the dark
renderer.readRenderTargetPixels(target, 0, 0, 128, 128, window.pixels);
document.title = 'done';
</script>"""


FILM_PAGE = """<!doctype html><script type="importmap">{"imports": {
"three": "/three/build/three.module.js"}}</script>
<script type="module">
import * as T from 'three';
const renderer = new T.WebGLRenderer(), said = new URLSearchParams(location.search);
const material = new T.ShaderMaterial({
  vertexShader: 'varying vec2 at; void main() { at = uv; gl_Position = vec4(position, 1.0); }',
  fragmentShader: `#define USE_IRIDESCENCE
    varying vec2 at; uniform float ior; uniform vec3 f0;
    #define PI 3.141592653589793
    float pow2(float x) { return x * x; }
    vec3 pow2(vec3 x) { return x * x; }
    // three.js approximates the fifth power
    float F_Schlick(float f0, float f90, float c) { return f0 + (f90 - f0) * pow(1.0 - c, 5.0); }
    vec3 F_Schlick(vec3 f0, float f90, float c) { return f0 + (f90 - f0) * pow(1.0 - c, 5.0); }
    #include <iridescence_fragment>
    void main() { gl_FragColor = vec4(evalIridescence(1.0, ior, at.x, 1000.0 * at.y, f0), 1.0); }`,
  uniforms: {ior: {value: +said.get('ior')},
             f0: {value: new T.Vector3(...said.get('f0').split(',').map(Number))}}});
const scene = new T.Scene().add(new T.Mesh(new T.PlaneGeometry(2, 2), material));
const target = new T.WebGLRenderTarget(64, 64, {type: T.FloatType});
renderer.setRenderTarget(target);
renderer.render(scene, new T.Camera());
window.pixels = new Float32Array(4 * 64 * 64);
renderer.readRenderTargetPixels(target, 0, 0, 64, 64, window.pixels);
document.title = 'done';
</script>"""


@pytest.fixture
def shown_by_three(tmp_path):
    """What shows pages of a folder that has three.js, and returns `window.pixels` of them."""
    need_node("three")
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium")
    (tmp_path / "three").symlink_to(NODE / "three")
    handler = functools.partial(Quiet, directory=str(tmp_path))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=WEBGL)
        page = browser.new_page()

        def show(address):
            page.goto(f"http://127.0.0.1:{server.server_port}/{address}")
            page.wait_for_function("document.title == 'done'", timeout=120_000)
            return np.array(page.evaluate("Array.from(window.pixels)"))

        yield show
        browser.close()
    server.shutdown()
    server.server_close()


@pytest.mark.slow
def test_three_js_shows_what_the_session_shows(tmp_path, shown_by_three):
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(sun=None), size=128)
    write_exr(tmp_path / "map.exr", scene.environment.image)
    (tmp_path / "index.html").write_text(PAGE)
    frames = {}
    for name in ("red-rubber", "gold-satin", "blue-plastic"):
        edit = tb.EditSession(scene)
        edit.assign("sphere", name)
        edit.export(tmp_path / f"{name}.glb")
        frames[name] = edit.render()
    inside = scene.part_image >= 0
    for name, frame in frames.items():
        theirs = shown_by_three(f"?file={name}.glb").reshape(128, 128, 4)[::-1, :, :3]
        off = np.abs(theirs - frame)[inside].mean() / frame[inside].mean()
        print(f"{name}: three.js differs by {100 * off:.1f} % of the mean")
        assert off < 0.15, name


@pytest.mark.slow
def test_films_are_those_of_three_js(tmp_path, shown_by_three):
    (tmp_path / "film.html").write_text(FILM_PAGE)
    middle = (np.arange(64) + 0.5) / 64
    for ior, f0 in ((1.3, (0.04, 0.5, 0.9)), (2.0, (0.02, 0.3, 0.7)), (1.6, (0.053, 0.05, 0.0))):
        address = f"film.html?ior={ior}&f0={','.join(map(str, f0))}"
        theirs = shown_by_three(address).reshape(64, 64, 4)[..., :3]
        ours = [thin_film(middle, ior, 1000.0 * nm, np.array(f0)) for nm in middle]
        assert np.abs(theirs - np.array(ours)).max() < 2e-3


@given(
    st.floats(1.0, 3.0), st.floats(0.0, 1000.0),
    st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3),
)  # fmt: skip
def test_films_are_bounded_and_vanish(ior, thickness, f0):
    cosine = np.linspace(0.0, 1.0, 33)
    found = thin_film(cosine, ior, thickness, np.array(f0))
    assert np.isfinite(found).all()
    assert found.min() >= 0.0
    assert found.max() < 2.5  # the specification's formula does not keep energy
    # none leaves the base, nearly, but where Schlick's term lets even air reflect
    steep = cosine[cosine > 0.7]
    none = thin_film(steep, ior, 0.0, np.array(f0))
    schlick = np.array(f0) + (1.0 - np.array(f0)) * (1.0 - steep[:, None]) ** 5
    assert np.allclose(none, schlick, atol=0.05)


def test_pearls_are_fitted_with_films(pixels):
    brdf = tb.default_library()["pearl-mustard-paint-29"]
    seen = pixels.of_table(brdf.values.reshape(-1, 3), np.asarray(brdf.mirror))
    plain = fit(GltfTarget(), pixels, seen, further=False)
    film = fit(GltfTarget(), pixels, seen)
    assert plain.look.iridescence < 0.01
    assert film.look.iridescence > 0.3
    assert film.error < min(0.05, 0.6 * plain.error)


def test_a_film_is_in_the_file(tmp_path):
    edit = tb.EditSession(tb.Scene(tb.sphere(), size=8))
    edit.assign("sphere", "pearl-mustard-paint-29")
    path = edit.export(tmp_path / "pearl.glb").files[0]
    said, _ = chunks(path)
    film = said["materials"][0]["extensions"]["KHR_materials_iridescence"]
    assert 0.3 < film["iridescenceFactor"] <= 1.0
    assert 1.0 <= film["iridescenceIor"] <= 3.0
    assert 0.0 < film["iridescenceThicknessMaximum"] <= 1000.0
    assert "KHR_materials_iridescence" in said["extensionsUsed"]


# -- MaterialX and Mitsuba ------------------------------------------------------------------------


def test_mtlx_is_valid_and_says_what_was_fitted(files):
    mx = pytest.importorskip("MaterialX")

    path = files["mtlx"].files[0]
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(path))
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    document.setDataLibrary(library)
    assert document.validate() == (True, "")
    assert document.getColorSpace() == "lin_rec709"
    lid = document.getNode("lid_surface")
    assert lid.getCategory() == "open_pbr_surface"
    assert lid.getInputValue("base_metalness") > 0.9
    assert lid.getInputValue("coat_darkening") == 0.0
    body = document.getNode("body_surface").getInput("specular_roughness").getConnectedNode()
    texture = path.parent / body.getInputValue("file")
    assert texture in files["mtlx"].files
    assert tb.load_mesh(path.with_suffix(".obj")).parts == tb.load_mesh(files["glb"].files[0]).parts
    assert max(files["mtlx"].errors.values()) < 0.06
    names = {one.getGeom() for one in document.getLooks()[0].getMaterialAssigns()}
    assert names == {f"/{part}" for part in files["mtlx"].errors}


@pytest.fixture(scope="module")
def peer():
    """Mitsuba, or the test is skipped."""
    from traitbrdf.bench import peers

    try:
        return peers.load()
    except RuntimeError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


def loaded(path):
    """What the program of an exported scene makes of its tables."""
    spec = importlib.util.spec_from_file_location("exported_scene", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.load(path.with_suffix(".npz"))


def interior(scene, count):
    """Some fragments whose pixels see nothing else."""
    covers = np.bincount(scene.pixels, minlength=scene.height * scene.width)
    inside = np.flatnonzero((covers[scene.pixels] == 1) & ~scene.bordering)
    return np.random.default_rng(0).choice(inside, count, replace=False)


@pytest.mark.slow
def test_mitsuba_shows_the_frame(peer, tmp_path):
    from traitbrdf.bench import peers

    scene = tb.Scene(tb.teapot(), lights=[tb.PointLight((2, 3, 2))], size=96)
    edit = tb.EditSession(scene)
    edit.assign(scene.shape.parts, "red-rubber")
    edit.assign("lid", "gold-polished")
    edit.assign("handle", "blue-plastic")
    edit.assign("spout", "gold-satin")
    line = tb.Stroke([(33, 54), (60, 54)], radius=10)
    edit.paint(line, tb.Move(shiny=0.6), where="local")
    theirs = loaded(edit.export(tmp_path / "pot.py", texture_size=512).files[0])
    chosen = interior(scene, 500)
    # twice, so that the noise is known
    pixels = scene.pixels[chosen]
    once, again = (peers.traced(peer, theirs, scene, pixels, 16384, seed) for seed in (0, 1))
    traced = 0.5 * (once + again)
    frame = edit.render().reshape(-1, 3)[pixels]
    off = np.abs(frame - traced).mean() / traced.mean()
    noise = 0.5 * np.abs(once - again).mean() / traced.mean()
    print(f"the frame is {100 * off:.2f} % off Mitsuba's, whose noise is {100 * noise:.2f} %")
    assert off < 0.005


@pytest.mark.slow
def test_mitsuba_shows_what_the_oracle_shows(peer, painted, files):
    from traitbrdf.bench import peers

    theirs, scene = loaded(files["py"].files[0]), painted.scene
    chosen = interior(scene, 60)
    traced = peers.traced(peer, theirs, scene, scene.pixels[chosen], 4096, 0)
    y, x = np.divmod(scene.pixels[chosen], 64)
    exact = np.empty((60, 3))
    for i, fragment in enumerate(chosen):
        part = scene.parts[scene.pixel_part[fragment]]
        at = (x[i] + 0.5, y[i] + 0.5) if part in painted.varying else None
        table = painted.brdf(part, at=at)
        exact[i] = tb.reference.fragments(scene, [fragment], [table], 1e-3)[0][0, 0]
    assert np.abs(traced - exact).mean() / exact.mean() < 0.02
    assert np.abs((traced - exact).mean()) / exact.mean() < 0.005


# -- refusals -------------------------------------------------------------------------------------


def test_bad_arguments_are_named_and_nothing_is_written(painted, tmp_path):
    with pytest.raises(ValueError, match=r"\.glb, \.mtlx, \.py"):
        painted.export(tmp_path / "pot.fbx")
    for size in (0, 8, 10_000, 64.0, True, "64"):
        with pytest.raises(ValueError, match="texture_size"):
            painted.export(tmp_path / "pot.glb", texture_size=size)
    assert not list(tmp_path.iterdir())


def test_an_export_can_be_cancelled(painted, tmp_path):
    def stop(stage, fraction):
        if stage.startswith("fitting"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        painted.export(tmp_path / "pot.glb", texture_size=32, progress=stop)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["pot.glb", "pot.mtlx", "pot.py"])
def test_an_unwritable_target_is_told_before_the_work(painted, tmp_path, name):
    def begun(stage, fraction):
        pytest.fail("work began")

    (tmp_path / name).mkdir()
    with pytest.raises(IsADirectoryError, match=name):
        painted.export(tmp_path / name, progress=begun)
    with pytest.raises(FileNotFoundError, match="expected an existing folder"):
        painted.export(tmp_path / "none" / name, progress=begun)


def test_names_of_all_kinds_are_kept(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    normals = np.broadcast_to((0.0, 0.0, 1.0), corners.shape)
    names = ["Größe #1", "脚/2"]
    both = np.concatenate([corners, corners + np.array([0, 0, 1])])
    shape = Mesh(both, [[0, 1, 2], [3, 4, 5]], np.concatenate([normals, normals]), [0, 1], names)
    edit = tb.EditSession(tb.Scene(shape, size=8))
    edit.assign(names, "red-rubber")
    made = edit.export(tmp_path / "tür.glb", texture_size=16)
    assert list(made.errors) == names
    assert tb.load_mesh(made.files[0]).parts == tuple(names)
    mtlx = edit.export(tmp_path / "tür.mtlx")
    assert mtlx.files[0].stat().st_size > 0
    assert edit.export(tmp_path / "tür.py").files[1].name == "tür.npz"
