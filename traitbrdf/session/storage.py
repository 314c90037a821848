"""Designs as files: the present view and light, materials, history, traits of one's own."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import FormatError, read_arrays, write_arrays
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, Light, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere, sphere
from traitbrdf.session.cache import fingerprint
from traitbrdf.session.frames import Said, framing_of
from traitbrdf.session.settings import Settings
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace, default_traits

_FORMAT = 2
_KEPT = ("quality", "error", "fps", "seed")


def write_design(
    path: str | PathLike[str],
    scene: Scene,
    materials: Mapping[str, Material],
    said: Sequence[Said],
    settings: Settings,
    traits: TraitSpace,
    embedding: BRDFEmbedding,
) -> None:
    """Write a design to one file, whole or not at all.

    Parameters
    ----------
    path : file to write
    scene, materials : what is looked at, and the material of each of its parts
    said : the calls that made the design, in order
    settings : what the session was asked for; its device and cache are not kept
    traits, embedding : that it was edited with

    Raises
    ------
    TypeError
        If the shape is neither a sphere nor a mesh.
    OSError
        If the file cannot be written.
    """
    framing = framing_of(scene)
    arrays: dict[str, NDArray[Any]] = {"environment": scene.environment.image}
    if isinstance(scene.shape, Mesh):
        mesh = scene.shape
        shape: dict[str, Any] = {"kind": "mesh", "parts": list(mesh.parts)}
        for name in ("vertices", "faces", "normals", "face_part", "uvs"):
            if getattr(mesh, name) is not None:
                arrays[f"shape_{name}"] = np.asarray(getattr(mesh, name))
    elif isinstance(scene.shape, Sphere):
        shape = {
            "kind": "sphere",
            "radius": float(scene.shape.radius),
            "center": np.asarray(scene.shape.center).tolist(),
        }
    else:
        raise TypeError(f"save: expected a sphere or a mesh, got {scene.shape!r}")
    named = []
    for i, part in enumerate(scene.parts):
        material = materials[part]
        arrays[f"z_{i}"], arrays[f"mirror_{i}"] = material.z, material.mirror
        for name in ("offset", "table"):
            value = getattr(material, name)
            if value is not None:
                arrays[f"{name}_{i}"] = value
        named.append({"part": part, "name": material.name})
    header = {
        "format": _FORMAT,
        "embedding": fingerprint(embedding),
        "shape": shape,
        "ground": scene.ground,
        "shadows": scene.shadows,
        "subsamples": scene.subsamples,
        "size": [scene.height, scene.width],
        "camera": vars(scene.camera),
        "rotation": scene.environment.rotation,
        "clipped_texels": scene.environment.clipped_texels,
        "lights": [{"kind": type(light).__name__, **vars(light)} for light in scene.lights],
        "materials": named,
        "history": [one.under(framing) for one in said],
        # what the strokes among them are where the picture is framed otherwise
        "anywhere": [one.anywhere if one.framing == framing else "" for one in said],
        **{name: getattr(settings, name) for name in _KEPT},
    }
    if traits is not default_traits():
        arrays |= {f"traits_{name}": value for name, value in traits.arrays().items()}
    arrays["design"] = np.array(json.dumps(header))
    write_arrays(path, arrays)


@dataclass(frozen=True)
class Stored:
    """A design as a file has it.

    Attributes
    ----------
    path : where it was read
    scene : Scene
    settings : "quality", "error", "fps" and "seed" of the session
    said : the calls that made it
    traits : None if they are the ones that the package ships
    header, arrays : all that the file holds
    """

    path: str | PathLike[str]
    scene: Scene
    settings: Mapping[str, Any]
    said: list[Said]
    traits: TraitSpace | None
    header: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    @classmethod
    def read(cls, path: str | PathLike[str]) -> Stored:
        """Read what `write_design` wrote, of format 1 or 2.

        Raises
        ------
        FileNotFoundError, traitbrdf.formats.files.FormatError
        """
        arrays = read_arrays(path)
        with reading(path):
            header = json.loads(str(arrays["design"]))
            if header["format"] == 1:
                header = {**header, **_BEFORE_SHADOWS, "anywhere": [""] * len(header["history"])}
            elif header["format"] != _FORMAT:
                raise FormatError(
                    path, f"a design of format 1 to {_FORMAT}", f"{header['format']!r}"
                )
            scene = _saved_scene(header, arrays)
            header = {"fps": None, **header}  # which older files do not have
            settings = {name: header[name] for name in _KEPT}
            Settings(**settings)  # what is wrong in the file is no mistake of the caller
            said = [
                Said(str(call), str(anywhere), framing_of(scene))
                for call, anywhere in zip(header["history"], header["anywhere"], strict=True)
            ]
            own = {k.removeprefix("traits_"): v for k, v in arrays.items() if "traits_" in k[:7]}
            traits = None
            if own:
                box = default_traits()
                traits = TraitSpace.from_arrays(own | {"low": box.low, "high": box.high})
        return cls(path, scene, settings, said, traits, header, arrays)

    def materials(self, embedding: BRDFEmbedding) -> dict[str, Material]:
        """The material of each part, by the embedding that the design was made with.

        Raises
        ------
        traitbrdf.formats.files.FormatError
            If it was made with another one: its coordinates would mean other materials.
        """
        with reading(self.path):
            expected, made = fingerprint(embedding), self.header["embedding"]
            if made != expected:
                raise FormatError(
                    self.path, f"a design of embedding {expected}", f"embedding {made}"
                )
            named = [entry["part"] for entry in self.header["materials"]]
            if named != list(self.scene.parts):
                raise FormatError(self.path, f"materials of {list(self.scene.parts)}", f"{named}")
            return {
                entry["part"]: _saved_material(i, str(entry["name"]), self.arrays, embedding)
                for i, entry in enumerate(self.header["materials"])
            }


@contextlib.contextmanager
def reading(path: str | PathLike[str]) -> Iterator[None]:
    """Whatever does not fit while a design is read is the file's fault."""
    try:
        yield
    except FormatError:
        raise
    except (
        KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError
    ) as error:  # fmt: skip
        raise FormatError(path, "a design written by EditSession.save", repr(error)) from error


_BEFORE_SHADOWS = {"ground": False, "shadows": False, "subsamples": 1}


def _saved_scene(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Scene:
    shape = header["shape"]
    made: Mesh | Sphere
    if shape["kind"] == "mesh":
        vertices, faces, normals, face_part = (
            arrays[f"shape_{name}"] for name in ("vertices", "faces", "normals", "face_part")
        )
        uvs = arrays.get("shape_uvs")
        made = Mesh(vertices, faces, normals, face_part, tuple(shape["parts"]), uvs)
    else:
        made = sphere(shape["radius"], shape["center"])
    lights: list[Light] = []
    for light in header["lights"]:
        values = {key: value for key, value in light.items() if key != "kind"}
        if light["kind"] == "PointLight":
            lights.append(PointLight(**values))
        elif light["kind"] == "DirectionalLight":
            lights.append(DirectionalLight(**values))
        else:
            raise ValueError(f"lights: expected point or directional lights, got {light['kind']!r}")
    environment = EnvironmentMap(arrays["environment"], header["rotation"])
    environment.clipped_texels = int(header["clipped_texels"])
    height, width = header["size"]
    return Scene(
        made, environment, lights, Camera(**header["camera"]), (height, width),
        ground=header["ground"], shadows=header["shadows"], subsamples=header["subsamples"],
    )  # fmt: skip


def _saved_material(
    index: int, name: str, arrays: Mapping[str, NDArray[Any]], embedding: BRDFEmbedding
) -> Material:
    offset, table = (arrays.get(f"{kind}_{index}") for kind in ("offset", "table"))
    shape = (embedding.grid_.size, 3)
    for kind, value in (("offset", offset), ("table", table)):
        if value is not None and not (value.shape == shape and np.isfinite(value).all()):
            raise ValueError(f"{kind}: expected finite numbers of shape {shape}, got {value.shape}")
    black = np.zeros((*embedding.grid_.shape, 3), np.float32)
    values = black if table is None else table.reshape(black.shape)
    # checks the values and the weight
    mirror = TabulatedBRDF(embedding.grid_, values, arrays[f"mirror_{index}"]).mirror
    return Material(
        embedding.as_coordinates(arrays[f"z_{index}"]),
        mirror,
        None if offset is None else offset.astype(np.float32),
        None if table is None else table.astype(np.float32),
        name,
    )
