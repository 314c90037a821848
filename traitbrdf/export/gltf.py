"""The metallic-roughness model of glTF 2.0 and its ratified extensions, and `.glb` files.

The model is that of the specification's appendix B with `KHR_materials_ior`, `_specular`,
`_clearcoat`, `_sheen` and `_iridescence`. Materials here are isotropic, so that `_anisotropy` has
nothing to say.
"""

from __future__ import annotations

import itertools
import json
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.export.baking import columns
from traitbrdf.export.lobes import ALPHAS, ANGLES, SHEENS, Pixels
from traitbrdf.export.pieces import Piece
from traitbrdf.formats.display import encode_srgb
from traitbrdf.formats.files import atomic_path
from traitbrdf.formats.images import png_bytes
from traitbrdf.scene.lights import Light, PointLight
from traitbrdf.scene.scene import Scene

Float64 = NDArray[np.float64]
RGB = tuple[float, float, float]

_DENSEST = 2.5  # index of refraction; a greater F0 is a tint
_COAT_F0 = 0.04  # that of an index of 1.5
_VISIBLE = 2e-3  # a weaker coat, sheen or film is left out
_THICKEST = 1000.0  # film, nm
_FILM_IORS = (1.4, 2.0)  # that fits start from
_FILM_NM = (150.0, 300.0, 450.0, 600.0, 800.0)
_PEAKS = np.array([5.4856e-13, 4.4201e-13, 5.2481e-13])  # of the CIE's curves as Gaussians
_PLACES = np.array([1.6810e6, 1.7953e6, 2.2084e6])
_WIDTHS = np.array([4.3278e9, 9.3046e9, 6.6121e9])
_REC709_OF_XYZ = np.array([  # from the left
    [3.2404542, -0.9692660, 0.0556434],
    [-1.5371385, 1.8760108, -0.2040259],
    [-0.4985314, 0.0415560, 1.0572252],
])  # fmt: skip


@dataclass(frozen=True)
class GltfLook:
    """Parameters of a glTF material, all linear.

    Attributes
    ----------
    base_color : RGB in [0, 1]
    metallic, roughness : float in [0, 1]
    f0 : RGB in [0, 1]
        Of the dielectric at normal incidence; `ior` and the specular colour say it in a file.
    specular : float in [0, 1]
        Weight of the dielectric's reflection.
    clearcoat, clearcoat_roughness : float in [0, 1]
    sheen_color : RGB in [0, 1]
    sheen_roughness : float in [0, 1]
    iridescence : float in [0, 1]
        Weight of a thin film.
    iridescence_ior : float in [1, 3]
    iridescence_thickness : float
        Of the film, nm.
    """

    base_color: RGB
    metallic: float
    roughness: float
    f0: RGB = (0.04, 0.04, 0.04)
    specular: float = 1.0
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    sheen_color: RGB = (0.0, 0.0, 0.0)
    sheen_roughness: float = 0.5
    iridescence: float = 0.0
    iridescence_ior: float = 1.3
    iridescence_thickness: float = 400.0

    @property
    def ior(self) -> float:
        """The index of refraction with the greatest channel of `f0`."""
        root = math.sqrt(min(max(self.f0), 0.999))
        return min((1.0 + root) / (1.0 - root), _DENSEST)

    @property
    def specular_color(self) -> RGB:
        """Factors (3,) that make `f0` of what `ior` reflects."""
        whole = max(((self.ior - 1.0) / (self.ior + 1.0)) ** 2, 1e-6)
        r, g, b = (channel / whole for channel in self.f0)
        return r, g, b


class GltfTarget:
    """`GltfLook` as a `traitbrdf.export.fitting.Target`."""

    size = 18

    def look(self, vector: Float64) -> GltfLook:
        """Return the parameters of a vector (18,) in [0, 1]."""
        v = [float(x) for x in vector]
        return GltfLook(
            base_color=(v[0] ** 2, v[1] ** 2, v[2] ** 2),
            metallic=v[3],
            roughness=_roughness(v[4]),
            f0=(v[5] ** 2, v[6] ** 2, v[7] ** 2),
            specular=v[8],
            clearcoat=v[9],
            clearcoat_roughness=_roughness(v[10]),
            sheen_color=(v[11] ** 2, v[12] ** 2, v[13] ** 2),
            sheen_roughness=math.sqrt(SHEENS[0]) + (1.0 - math.sqrt(SHEENS[0])) * v[14],
            iridescence=v[15],
            iridescence_ior=1.0 + 2.0 * v[16],
            iridescence_thickness=_THICKEST * v[17],
        )

    def starts(self, colour: Float64, roughness: float) -> Iterator[Float64]:
        """Return a plastic, a metal, a coated body and a cloth of a colour and roughness."""
        root = np.sqrt(colour)
        plain = np.full(self.size, 0.01)
        plain[:3], plain[4], plain[5:8], plain[8] = root, roughness, 0.2, 0.9
        plain[10], plain[14] = 0.2, 0.5
        plain[15], plain[16], plain[17] = 0.0, 0.2, 0.4
        yield plain
        metal = plain.copy()
        metal[3] = 0.98
        yield metal
        coated = plain.copy()
        coated[9], coated[4] = 0.9, min(1.6 * roughness, 0.95)
        coated[10] = 0.4 * roughness
        yield coated
        cloth = plain.copy()
        cloth[11:14], cloth[8], cloth[14] = 0.4 * root, 0.3, roughness
        yield cloth

    def further(self, vector: Float64) -> Iterator[Float64]:
        """Return vectors of the same look under thin films."""
        for metal, ior, thickness in itertools.product((0.02, 0.9), _FILM_IORS, _FILM_NM):
            film = vector.copy()
            film[3] = metal
            film[15], film[16], film[17] = 0.7, 0.5 * (ior - 1.0), thickness / _THICKEST
            yield film

    def cost(self, vector: Float64) -> Float64:
        """Return residuals (7,): coat, sheen and film only where they show, metal or none."""
        between_both = vector[3] * (1.0 - vector[3])
        some = [vector[9], *vector[11:14], between_both, 1.0 - vector[8], vector[15]]
        return 0.003 * np.array(some)

    def image(self, look: GltfLook, pixels: Pixels) -> Float64:
        """Return the radiance (m, 3) of pixels, as the specification's appendix B has it."""
        alpha = look.roughness**2
        base = np.array(look.base_color)
        f0 = np.array(look.f0)
        grazing = (1.0 - ANGLES[:, None]) ** 5
        metal = base + (1.0 - base) * grazing
        surface = f0 + (1.0 - f0) * grazing
        film = look.iridescence
        if film > 1e-3:
            ior, thickness = look.iridescence_ior, look.iridescence_thickness
            metal = (1.0 - film) * metal + film * thin_film(ANGLES, ior, thickness, base)
            surface = (1.0 - film) * surface + film * thin_film(ANGLES, ior, thickness, f0)
        surface = look.specular * surface
        through = np.maximum(1.0 - surface.max(axis=1, keepdims=True), 0.0)
        lobe = pixels.ggx(alpha)
        dielectric = lobe @ surface + base * (pixels.diffuse() @ through)
        image = look.metallic * (lobe @ metal) + (1.0 - look.metallic) * dielectric
        sheen = np.array(look.sheen_color)
        if sheen.max() > 1e-4:
            rough = look.sheen_roughness**2
            fibres, hidden = pixels.sheen(rough), pixels.sheen_albedo(rough)
            left = np.maximum(1.0 - sheen.max() * hidden, 0.0)
            image = image * left[:, None] + sheen * fibres[:, None]
        if look.clearcoat > 1e-4:
            fresnel = _COAT_F0 + (1.0 - _COAT_F0) * (1.0 - pixels.cosine) ** 5
            coat = pixels.ggx(look.clearcoat_roughness**2).sum(axis=1)
            weight = (look.clearcoat * fresnel)[:, None]
            image = image * (1.0 - weight) + weight * coat[:, None]
        return np.asarray(image, np.float64)


def thin_film(cosine: Float64, ior: float, thickness: float, f0: Float64) -> Float64:
    """Return the Fresnel term (m, 3) of a base under a thin film, as `KHR_materials_iridescence`.

    Belcour & Barla, "A Practical Extension to Microfacet Theory for the Modeling of Varying
    Iridescence" (2017), with Schlick's terms and two orders of interference.

    Parameters
    ----------
    cosine : (m,) float64, of the angle of difference
    ior : float
        Of the film, at least 1.
    thickness : float
        nm. A film of 0 nm has the index of air, so that the base is nearly as it is without.
    f0 : (3,) float64 in [0, 1]
        Of the base in air.
    """
    t = min(max(thickness / 0.03, 0.0), 1.0)
    ior = 1.0 + (ior - 1.0) * t * t * (3.0 - 2.0 * t)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)[:, None]
    away = (1.0 - cosine[:, None]) ** 5
    flat = ((ior - 1.0) / (ior + 1.0)) ** 2
    top = flat + (1.0 - flat) * away
    root = np.sqrt(np.clip(f0, 0.0, 0.9999))
    base = (1.0 + root) / (1.0 - root)
    below = ((base - ior) / (base + ior)) ** 2
    below = below + (1.0 - below) * (1.0 - inside) ** 5
    turn = np.where(base < ior, 2.0 * math.pi, math.pi)  # of phase, at both interfaces
    both = np.clip(top * below, 1e-5, 0.9999)
    returned = (1.0 - top) ** 2 * below / (1.0 - both)
    found = top + returned
    wave = returned - (1.0 - top)
    for order in (1, 2):
        wave = wave * np.sqrt(both)
        phase = 2.0 * math.pi * 1e-9 * order * 2.0 * ior * thickness * inside
        found = found + wave * 2.0 * _sensitivity(phase, order * turn)
    return np.asarray(np.maximum(found, 0.0))


def _sensitivity(phase: Float64, turn: Float64) -> Float64:
    """Return what eyes see (m, 3) of a cosine over wave numbers, in linear Rec.709.

    Belcour & Barla's Gaussians of the CIE's curves, for phases (m, 1) and shifts (3,).
    """
    found = _PEAKS * np.sqrt(2.0 * math.pi * _WIDTHS) * np.cos(_PLACES * phase + turn)
    found = found * np.exp(-(phase**2) * _WIDTHS)
    second = math.sqrt(2.0 * math.pi * 4.5282e9) * np.cos(2.2399e6 * phase[:, 0] + turn[0])
    found[:, 0] += 9.7470e-14 * second * np.exp(-4.5282e9 * phase[:, 0] ** 2)
    return np.asarray(found / 1.0685e-7 @ _REC709_OF_XYZ)


def _roughness(value: float) -> float:
    """Return a roughness whose alpha the fit's lobes have."""
    least = math.sqrt(ALPHAS[0])
    return least + (1.0 - least) * value


# -- files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GltfPart:
    """One part of a file.

    Attributes
    ----------
    piece : Piece
    look : GltfLook
        Of the whole part, or where nothing is painted locally.
    textures : (size, size, p) float64 or None
        What `as_values` gives of each texel's look.
    """

    piece: Piece
    look: GltfLook
    textures: Float64 | None = None


def write_glb(path: str | PathLike[str], scene: Scene, parts: Sequence[GltfPart]) -> None:
    """Write parts, camera and lights as binary glTF 2.0.

    The light of the map is not written: glTF has no ratified extension for it.

    Parameters
    ----------
    path : path-like
    scene : Scene
        Its camera and lights are written.
    parts : sequence of GltfPart

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    file = _File()
    for part in parts:
        file.add(part)
    file.view(scene)
    with atomic_path(path) as temporary:
        temporary.write_bytes(file.packed())


class _File:
    """A glTF file while it is put together."""

    def __init__(self) -> None:
        self._binary = bytearray()
        self._used: set[str] = set()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "traitbrdf"},
            "scene": 0,
            "scenes": [{"nodes": []}],
        }

    def packed(self) -> bytes:
        """Return the file: a header, the JSON and the binary chunk, each in whole fours."""
        self._json["buffers"] = [{"byteLength": len(self._binary)}]
        if self._used:
            self._json["extensionsUsed"] = sorted(self._used)
        text = json.dumps(self._json, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self._binary)
        return b"".join([
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"), text,
            struct.pack("<I4s", len(self._binary), b"BIN\0"), bytes(self._binary),
        ])  # fmt: skip

    def add(self, part: GltfPart) -> None:
        """Add a node with the mesh and the material of a part."""
        piece = part.piece
        attributes = {
            "POSITION": self._accessor(piece.positions.astype(np.float32), "VEC3", True),
            "NORMAL": self._accessor(_normalised(piece.normals), "VEC3"),
        }
        if piece.uvs is not None:  # v is down in glTF
            uvs = np.stack([piece.uvs[:, 0], 1.0 - piece.uvs[:, 1]], axis=1)
            attributes["TEXCOORD_0"] = self._accessor(uvs.astype(np.float32), "VEC2")
        indices = self._accessor(piece.faces.astype(np.uint32).reshape(-1), "SCALAR")
        material = self._append("materials", self._material(part))
        primitive = {"attributes": attributes, "indices": indices, "material": material}
        mesh = self._append("meshes", {"name": piece.name, "primitives": [primitive]})
        self._node({"name": piece.name, "mesh": mesh})

    def view(self, scene: Scene) -> None:
        """Add the camera and the lights."""
        camera, size = scene.camera, (scene.height, scene.width)
        eye = camera.position(scene.shape, *size)
        corner = camera.through(*size, np.array([0.0, 1.0, 0.5]), np.array([0.5, 0.5, 0.0]))
        middle = camera.through(*size, np.array(0.5 * scene.width), np.array(0.5 * scene.height))
        right = corner[1] - corner[0]
        right -= middle * (right @ middle)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :4] = np.stack([right, np.cross(right, middle), -middle, eye], axis=1)
        away = float(np.linalg.norm(eye - scene.shape.center))
        lens = {
            "yfov": math.radians(camera.fov),
            "aspectRatio": scene.width / scene.height,
            "znear": max(away - 8.0 * scene.shape.radius, 0.01 * away),
            "zfar": away + 20.0 * scene.shape.radius,
        }
        index = self._append("cameras", {"type": "perspective", "perspective": lens})
        self._node({"name": "camera", "camera": index, "matrix": matrix.T.ravel().tolist()})
        for light in scene.lights:
            self._light(light)

    def _light(self, light: Light) -> None:
        self._used.add("KHR_lights_punctual")
        point = isinstance(light, PointLight)
        power = light.intensity if isinstance(light, PointLight) else light.irradiance
        most = max(*power, 1e-30)
        said = {
            "type": "point" if point else "directional",
            "color": [channel / most for channel in power],
            "intensity": most,
        }
        extensions = self._json.setdefault("extensions", {})
        known = extensions.setdefault("KHR_lights_punctual", {"lights": []})["lights"]
        known.append(said)
        node: dict[str, Any] = {"extensions": {"KHR_lights_punctual": {"light": len(known) - 1}}}
        if isinstance(light, PointLight):
            node["translation"] = list(light.position)
        else:  # it shines along -z
            node["rotation"] = _turn(np.asarray(light.direction)).tolist()
        self._node(node)

    def _material(self, part: GltfPart) -> dict[str, Any]:
        look, maps = part.look, part.textures
        core: dict[str, Any] = {
            "baseColorFactor": [*look.base_color, 1.0],
            "metallicFactor": look.metallic,
            "roughnessFactor": look.roughness,
        }
        specular: dict[str, Any] = {"specularFactor": look.specular}
        coat: dict[str, Any] = {
            "clearcoatFactor": look.clearcoat,
            "clearcoatRoughnessFactor": look.clearcoat_roughness,
        }
        sheen: dict[str, Any] = {
            "sheenColorFactor": list(look.sheen_color),
            "sheenRoughnessFactor": look.sheen_roughness,
        }
        extensions: dict[str, Any] = {}
        if maps is None:
            extensions["KHR_materials_ior"] = {"ior": look.ior}
            specular["specularColorFactor"] = list(look.specular_color)
            coated, fuzzy = look.clearcoat > _VISIBLE, max(look.sheen_color) > _VISIBLE
            if look.iridescence > _VISIBLE:
                extensions["KHR_materials_iridescence"] = {
                    "iridescenceFactor": look.iridescence,
                    "iridescenceIor": look.iridescence_ior,
                    "iridescenceThicknessMinimum": look.iridescence_thickness,
                    "iridescenceThicknessMaximum": look.iridescence_thickness,
                }
        else:
            at = {name: maps[..., place] for name, place in columns(look).items()}
            core["baseColorFactor"] = [1.0] * 4
            core["metallicFactor"] = core["roughnessFactor"] = 1.0
            core["baseColorTexture"] = self._texture(at["base_color"])
            rough = [np.zeros_like(at["metallic"]), at["roughness"], at["metallic"]]
            core["metallicRoughnessTexture"] = self._texture(*rough, linear=True)
            # F0 is the colour times what an index of 1.5 reflects
            tint = at["f0"] / _COAT_F0
            most = np.maximum(tint.reshape(-1, 3).max(axis=0), 1e-6)
            both = self._texture(tint / most, at["specular"])
            specular = {
                "specularFactor": 1.0, "specularColorFactor": most.tolist(),
                "specularTexture": both, "specularColorTexture": both,
            }  # fmt: skip
            coated = bool(at["clearcoat"].max() > _VISIBLE)
            fuzzy = bool(at["sheen_color"].max() > _VISIBLE)
            if coated:
                both = self._texture(
                    at["clearcoat"], at["clearcoat_roughness"], 0.0 * at["clearcoat"], linear=True
                )
                coat = {
                    "clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 1.0,
                    "clearcoatTexture": both, "clearcoatRoughnessTexture": both,
                }  # fmt: skip
            if fuzzy:
                both = self._texture(at["sheen_color"], at["sheen_roughness"])
                sheen = {
                    "sheenColorFactor": [1.0] * 3, "sheenRoughnessFactor": 1.0,
                    "sheenColorTexture": both, "sheenRoughnessTexture": both,
                }  # fmt: skip
        extensions["KHR_materials_specular"] = specular
        if coated:
            extensions["KHR_materials_clearcoat"] = coat
        if fuzzy:
            extensions["KHR_materials_sheen"] = sheen
        self._used |= set(extensions)
        name = part.piece.name
        return {"name": name, "pbrMetallicRoughness": core, "extensions": extensions}

    def _texture(self, *channels: Float64, linear: bool = False) -> dict[str, int]:
        """Add a texture of 3 channels, or of a colour and an alpha; colours in sRGB."""
        values = np.clip(np.concatenate(channels, axis=-1), 0.0, 1.0)
        pixels = np.round(255.0 * values).astype(np.uint8)
        if not linear:
            pixels[..., :3] = encode_srgb(values[..., :3])
        data = png_bytes(np.ascontiguousarray(pixels))
        image = self._append("images", {"mimeType": "image/png", "bufferView": self._view(data)})
        return {"index": self._append("textures", {"source": image})}

    def _accessor(self, values: NDArray[Any], kind: str, bounds: bool = False) -> int:
        index = kind == "SCALAR"
        said: dict[str, Any] = {
            "bufferView": self._view(values.tobytes(), 34963 if index else 34962),
            "componentType": 5125 if index else 5126, "count": len(values), "type": kind,
        }  # fmt: skip
        if bounds:
            said["min"], said["max"] = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        return self._append("accessors", said)

    def _view(self, data: bytes, target: int | None = None) -> int:
        view: dict[str, Any] = {
            "buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data),
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        self._binary += data + b"\0" * (-len(data) % 4)
        return self._append("bufferViews", view)

    def _append(self, kind: str, one: dict[str, Any]) -> int:
        known: list[dict[str, Any]] = self._json.setdefault(kind, [])
        known.append(one)
        return len(known) - 1

    def _node(self, node: dict[str, Any]) -> None:
        self._json["scenes"][0]["nodes"].append(self._append("nodes", node))


def _normalised(normals: Float64) -> NDArray[np.float32]:
    unit = normals.astype(np.float32)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return unit


def _turn(toward: Float64) -> Float64:
    """Return the unit quaternion (x, y, z, w) that turns +z to a direction."""
    axis = np.array([-toward[1], toward[0], 0.0])
    if toward[2] < -1.0 + 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    q = np.append(axis, 1.0 + toward[2])
    return np.asarray(q / np.linalg.norm(q))
