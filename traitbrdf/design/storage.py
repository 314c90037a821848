"""Designs as files (.tbr): the present view and light, materials, layers, traits of one's own.

A file is one archive of arrays; the array "design" is a JSON header. Nothing in it is executed.
Materials that appear several times stand once, and so do their arrays. What every layer came to is
stored beside it, so that a design opens as it was saved, whatever later versions make of its
effects; layers that change afterwards are computed anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.document import Design, Document, Recorded
from traitbrdf.design.effects import KINDS, MODELS, Applied, Assign, Palette
from traitbrdf.design.layers import Layer
from traitbrdf.design.masks import Brushed, Framing, Local, Painted, Parts
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.files import FormatError, read_arrays, write_arrays
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.reflectance.models import Model
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, Light, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere, sphere
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace, default_traits

_FORMAT = 4
_LAYERED = (3, _FORMAT)  # formats with layers
SETTINGS = ("quality", "error", "fps", "seed")
"""Settings of a session that a file keeps."""

_VALUES: dict[str, type[Any]] = {
    **KINDS,
    **{
        kind.__name__: kind
        for kind in (Parts, Painted, Local, Brushed, Framing, Stroke, Camera, *MODELS)
    },
}
"""Values that may stand in the fields of effects and masks, by the name that a file gives them."""


def write_design(
    path: str | PathLike[str], scene: Scene, document: Document, settings: Mapping[str, Any]
) -> None:
    """Write a design to one file, whole or not at all.

    Parameters
    ----------
    path : file to write
    scene : Scene, what is looked at
    document : Document; what was undone is not kept
    settings : "quality", "error", "fps" and "seed" of the session

    Raises
    ------
    TypeError
        If the shape is neither a sphere nor a mesh.
    OSError
        If the file cannot be written.
    """
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
    design, palette = document.design, document.palette
    pool = _Pool(palette)
    header = {
        "format": _FORMAT,
        "embedding": palette.embedding.fingerprint(),
        "shape": shape,
        "ground": scene.ground,
        "shadows": scene.shadows,
        "subsamples": scene.subsamples,
        "size": [scene.height, scene.width],
        "camera": vars(scene.camera),
        "rotation": scene.environment.rotation,
        "clipped_texels": scene.environment.clipped_texels,
        "lights": [{"kind": type(light).__name__, **vars(light)} for light in scene.lights],
        "below": {part: pool.place(design.materials[part]) for part in scene.parts},
        "layers": [
            {
                **{f.name: pool.plain(getattr(layer, f.name)) for f in _LAYER},
                "after": {part: pool.place(one.material) for part, one in after.items()},
                "refused": [part for part, one in after.items() if one.refused],
            }
            for layer, after in zip(design.layers, document.outcomes, strict=True)
        ],
        "recorded": [[r.call, r.anywhere, pool.plain(r.framing)] for r in design.recorded],
        "materials": pool.entries,
        **{name: settings[name] for name in SETTINGS},
    }
    arrays |= pool.arrays()
    if palette.traits is not default_traits():
        arrays |= {f"traits_{name}": value for name, value in palette.traits.arrays().items()}
    arrays["design"] = np.array(json.dumps(header))
    write_arrays(path, arrays)


_LAYER = [f for f in dataclasses.fields(Layer) if f.name != "key"]


class _Pool:
    """Materials of a file, each of which stands there once."""

    def __init__(self, palette: Palette) -> None:
        self._palette = palette
        self.entries: list[dict[str, Any]] = []
        self._places: dict[Material, int] = {}
        self._points: list[NDArray[np.float64]] = []
        self._mirrors: list[NDArray[np.float64]] = []
        self._tables: dict[int, tuple[int, NDArray[Any]]] = {}
        self._assigned: dict[int, Any] = {}

    def place(self, material: Material) -> int:
        """Return the index of a material among the file's."""
        if material not in self._places:
            self._places[material] = len(self.entries)
            self._points.append(material.z)
            self._mirrors.append(material.mirror)
            self.entries.append({
                "name": material.name,
                "offset": self._table(material.offset),
                "table": self._table(material.table),
                "model": self.plain(material.model),
            })  # fmt: skip
        return self._places[material]

    def _table(self, values: NDArray[Any] | None) -> int | None:
        if values is None:
            return None
        return self._tables.setdefault(id(values), (len(self._tables), values))[0]

    def plain(self, value: Any) -> Any:
        """Return the field of an effect or a mask as JSON can hold it."""
        if isinstance(value, Material):
            return {"material": self.place(value)}
        kind = type(value).__name__
        if _VALUES.get(kind) is type(value):
            if kind in KINDS:
                state = dict(value.state(self._palette))
                if isinstance(value, Assign) and value.table is not None:
                    # a table that is assigned twice stays one table
                    state["known"] = self._assigned.setdefault(id(value.table), state["known"])
            elif dataclasses.is_dataclass(value):
                state = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            else:
                state = value._asdict()
            return {"is": kind, **{name: self.plain(one) for name, one in state.items()}}
        if isinstance(value, (tuple, list)):
            return [self.plain(one) for one in value]
        if isinstance(value, np.generic):
            return value.item()
        if value is None or isinstance(value, (str, bool, int, float)):
            return value
        raise TypeError(f"save: expected a value that a design file can hold, got {value!r}")

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the entries refer to."""
        tables = {f"table_{i}": values for i, values in self._tables.values()}
        return {"points": np.array(self._points), "mirrors": np.array(self._mirrors), **tables}


@dataclass(frozen=True)
class Stored:
    """A design as a file has it.

    Attributes
    ----------
    path : where it was read
    scene : Scene
    settings : "quality", "error", "fps" and "seed" of the session
    traits : None if they are the ones that the package ships
    header, arrays : all that the file holds
    """

    path: str | PathLike[str]
    scene: Scene
    settings: Mapping[str, Any]
    traits: TraitSpace | None
    header: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    @classmethod
    def read(cls, path: str | PathLike[str]) -> Stored:
        """Read what `write_design` wrote, of format 1 to 4.

        Raises
        ------
        FileNotFoundError, traitbrdf.formats.files.FormatError
        """
        arrays = read_arrays(path)
        with reading(path):
            header = json.loads(str(arrays["design"]))
            if header["format"] == 1:
                header = {**header, **_BEFORE_SHADOWS, "anywhere": [""] * len(header["history"])}
            elif header["format"] not in (2, *_LAYERED):
                raise FormatError(
                    path, f"a design of format 1 to {_FORMAT}", f"{header['format']!r}"
                )
            scene = _saved_scene(header, arrays)
            header = {"fps": None, **header}  # which older files do not have
            settings = {name: header[name] for name in SETTINGS}
            own = {k.removeprefix("traits_"): v for k, v in arrays.items() if "traits_" in k[:7]}
            traits = None
            if own:
                box = default_traits()
                traits = TraitSpace.from_arrays(own | {"low": box.low, "high": box.high})
        return cls(path, scene, settings, traits, header, arrays)

    def document(self, palette: Palette) -> Document:
        """Return the design and what its layers came to.

        Raises
        ------
        traitbrdf.formats.files.FormatError
            If it was made with another embedding than the palette's: its coordinates would mean
            other materials.
        """
        with reading(self.path):
            expected, made = palette.embedding.fingerprint(), self.header["embedding"]
            if made != expected:
                raise FormatError(
                    self.path, f"a design of embedding {expected}", f"embedding {made}"
                )
            if self.header["format"] in _LAYERED:
                return self._layered(palette)
            return Document(self._baked(palette.embedding), palette)

    def _baked(self, embedding: BRDFEmbedding) -> Design:
        """Read a design of format 1 or 2: materials, and the calls that led to them."""
        header, framing = self.header, Framing.of(self.scene)
        self._check_parts([entry["part"] for entry in header["materials"]])
        materials = {
            entry["part"]: _saved_material(
                embedding,
                str(entry["name"]),
                self.arrays[f"z_{i}"],
                self.arrays[f"mirror_{i}"],
                self.arrays.get(f"offset_{i}"),
                self.arrays.get(f"table_{i}"),
            )
            for i, entry in enumerate(header["materials"])
        }
        recorded = tuple(
            Recorded(str(call), str(anywhere), framing)
            for call, anywhere in zip(header["history"], header["anywhere"], strict=True)
        )
        return Design(materials, (), recorded)

    def _layered(self, palette: Palette) -> Document:
        header, arrays = self.header, self.arrays
        # one array for all materials that share it: they are equal then
        tables = {name: value for name, value in arrays.items() if name.startswith("table_")}
        materials: list[Material] = []
        effects: dict[str, Any] = {}  # equal ones are one object, and so are their tables

        def value(plain: Any) -> Any:
            if isinstance(plain, list):
                return tuple(value(one) for one in plain)
            if not isinstance(plain, dict):
                return plain
            if "material" in plain and "is" not in plain:
                return materials[plain["material"]]
            state = {name: value(one) for name, one in plain.items() if name != "is"}
            if plain["is"] in KINDS:
                said = json.dumps(plain)
                if said not in effects:
                    effects[said] = KINDS[plain["is"]].restored(state, palette)
                return effects[said]
            return _VALUES[plain["is"]](**state)

        def table_at(place: int | None) -> NDArray[Any] | None:
            return None if place is None else tables[f"table_{place}"]

        materials += [
            _saved_material(
                palette.embedding,
                str(entry["name"]),
                arrays["points"][i],
                arrays["mirrors"][i],
                table_at(entry["offset"]),
                table_at(entry["table"]),
                value(entry.get("model")),
            )
            for i, entry in enumerate(header["materials"])
        ]

        def placed(places: Mapping[str, int]) -> dict[str, Material]:
            return {part: materials[place] for part, place in places.items()}

        below = placed(header["below"])
        self._check_parts(list(below))
        layers, known = [], []
        for entry in header["layers"]:
            layer = Layer(**{f.name: value(entry[f.name]) for f in _LAYER})
            after = placed(entry["after"])
            if (*after,) != layer.mask.parts or not after.keys() <= below.keys():
                raise ValueError(f"layers: expected outcomes of {layer.mask.parts}, got {[*after]}")
            layers.append(layer)
            refused = set(entry["refused"])
            known.append({part: Applied(one, None, part in refused) for part, one in after.items()})
        recorded = tuple(
            Recorded(str(call), str(anywhere), value(framing))
            for call, anywhere, framing in header["recorded"]
        )
        return Document(Design(below, tuple(layers), recorded), palette, known)

    def _check_parts(self, named: list[str]) -> None:
        if named != list(self.scene.parts):
            raise FormatError(self.path, f"materials of {list(self.scene.parts)}", f"{named}")


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
    embedding: BRDFEmbedding,
    name: str,
    z: NDArray[Any],
    mirror: NDArray[Any],
    offset: NDArray[Any] | None,
    table: NDArray[Any] | None,
    model: Model | None = None,
) -> Material:
    shape = (embedding.grid_.size, 3)
    for kind, value in (("offset", offset), ("table", table)):
        if value is not None and not (value.shape == shape and np.isfinite(value).all()):
            raise ValueError(f"{kind}: expected finite numbers of shape {shape}, got {value.shape}")
    if model is not None and not isinstance(model, Model):
        raise TypeError(f"model: expected a closed form, got {model!r}")
    black = np.zeros((*embedding.grid_.shape, 3), np.float32)
    values = black if table is None else table.reshape(black.shape)
    # checks the values and the weight
    mirror = TabulatedBRDF(embedding.grid_, values, mirror).mirror
    return Material(
        embedding.as_coordinates(z),
        mirror,
        None if offset is None else np.asarray(offset, np.float32),
        None if table is None else np.asarray(table, np.float32),
        name,
        model,
    )
