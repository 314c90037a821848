"""EditSession: materials on the parts of a scene, edited by traits and shown at once.

Every part (region) of the shape has one material: coordinates in the embedding, and, where a
table or a model was assigned, what that table has beyond the manifold, which edits keep. All
edits are undone and redone one at a time; a stroke is one edit.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import Reflectance, TabulatedBRDF
from traitbrdf.embedding import BRDFEmbedding, Library, default_library
from traitbrdf.formats import FormatError, read_arrays, unknown_name, write_arrays
from traitbrdf.lights import DirectionalLight, EnvironmentMap, Light, PointLight
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import Mesh, Sphere, sphere
from traitbrdf.strokes import Stroke, region_weights
from traitbrdf.traits import GROUPS, TraitSpace, default_traits
from traitbrdf.transport import PartFrame, Progress, Training, Transport, training_tables

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

QUALITIES: dict[str, tuple[int, float]] = {
    "preview": (24, 0.7),
    "interactive": (64, 1.0),
    "accurate": (112, 1.5),
}
"""Basis images and resolution of the light for each quality."""

EXACT_ABOVE = 0.05
"""A part whose measured error is greater is rendered without the basis, if no error is asked."""

_FORMAT = 1
_FIRST_MATERIAL = "white-plastic"


@dataclass(frozen=True, eq=False)
class Material:
    """What one part is made of.

    Attributes
    ----------
    z : (k,) coordinates
    mirror : (3,) weight of a perfect mirror beside the table
    offset : (cells, 3) or None, what an assigned table has in log f beyond the manifold
    table : (cells, 3) or None, an assigned table as it came, until it is edited
    name : what it was assigned from
    """

    z: Float64
    mirror: Float64
    offset: Float32 | None = None
    table: Float32 | None = None
    name: str = ""

    def values(self, embedding: BRDFEmbedding) -> Float32:
        """f_r (cells, 3) on the embedding's grid."""
        if self.table is not None:
            return self.table
        return embedding.decode_values(self.z, self.offset)


@dataclass(frozen=True)
class _Edit:
    """One undoable step: the materials before and after, and the call that did it."""

    before: dict[str, Material]
    after: dict[str, Material]
    call: str


class EditSession:
    """Materials of a scene's parts, edited by traits, rendered in real time.

    Parameters
    ----------
    scene : Scene
    quality : "preview", "interactive" or "accurate"
    error : float or None
        The mean relative L1 that every shown part has to meet by its own measurement; parts that
        do not are rendered without the basis, which takes seconds. None is 0.05.
    library, embedding, traits : what to edit with; None is what the package ships
    device : torch device for frames
    seed : int, of the preparation's random choices
    progress : called with (stage, fraction) while the scene is prepared; may raise to cancel

    Notes
    -----
    The scene is prepared at the first `render` (or by `prepare`).
    """

    def __init__(
        self,
        scene: Scene,
        quality: str = "interactive",
        error: float | None = None,
        library: Library | None = None,
        traits: TraitSpace | None = None,
        device: str | torch.device = "cpu",
        seed: int = 0,
        progress: Progress | None = None,
    ) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a Scene, got {scene!r}")
        if quality not in QUALITIES:
            raise ValueError(unknown_name("quality", quality, tuple(QUALITIES)))
        if error is not None and not (math.isfinite(error) and error > 0.0):
            raise ValueError(f"error: expected a positive number, got {error!r}")
        self.scene = scene
        self.quality = quality
        self.error = error
        self.library = default_library() if library is None else library
        self.embedding = self.library.embedding
        self.traits = default_traits() if traits is None else traits
        self.device = torch.device(device)
        self.seed = seed
        self._progress = progress
        self._transport: Transport | None = None
        self._frames: dict[str, tuple[Material, PartFrame, str]] = {}
        self._times: dict[str, float] = {}
        first = _FIRST_MATERIAL if _FIRST_MATERIAL in self.library else self.library.names[0]
        self._materials = {part: self._from_library(first) for part in scene.parts}
        self._done: list[_Edit] = []
        self._undone: list[_Edit] = []
        self._replayed: list[str] = []

    def __repr__(self) -> str:
        return f"EditSession({self.scene!r}, quality={self.quality!r}, {len(self._done)} edits)"

    # -- materials ------------------------------------------------------------------------------

    def part(self, name: str) -> int:
        """Index of a part; an unknown name raises ValueError naming the near ones."""
        if name not in self.scene.parts:
            raise ValueError(unknown_name("part", name, self.scene.parts))
        return self.scene.parts.index(name)

    def material(self, part: str) -> Material:
        """The material of a part."""
        self.part(part)
        return self._materials[part]

    def scores(self, part: str) -> dict[str, float]:
        """Every trait's score of a part's material."""
        return self.traits.score(self.material(part).z)

    def brdf(self, part: str) -> TabulatedBRDF:
        """A part's material as a table: ``.write("x.binary")`` saves it."""
        material = self.material(part)
        grid = self.embedding.grid_
        values = material.values(self.embedding).reshape(*grid.shape, 3)
        return TabulatedBRDF(grid, values, material.mirror, material.name or part)

    def _energy_scale(self, material: Material) -> float:
        if material.table is not None:  # shown as it came
            return 1.0
        return self.embedding.energy_scale(material.z, material.offset)

    def _from_library(self, name: str) -> Material:
        z = self.library.coordinates[self.library.index(name)]
        return Material(self.embedding.clip(z), np.zeros(3), name=name)

    # -- edits ----------------------------------------------------------------------------------

    def assign(self, part: str | Iterable[str], material: str | Reflectance | ArrayLike) -> None:
        """Give one part (or several) a material.

        Parameters
        ----------
        part : name or names of parts
        material : a library name, a `TabulatedBRDF`, a model or measured BRDF, or coordinates (k,)

        Raises
        ------
        ValueError
            On an unknown part or material, or coordinates of a wrong shape.
        TypeError
            On something that is no material.
        """
        names = [part] if isinstance(part, str) else list(part)
        if not names:
            raise ValueError("part: expected at least one name, got none")
        for name in names:
            self.part(name)
        if isinstance(material, str):
            new, said = self._from_library(material), repr(material)
        elif callable(getattr(material, "eval", None)):
            new = self._from_reflectance(material)  # type: ignore[arg-type]
            said = f"{material!r}"
        elif isinstance(material, (list, tuple, np.ndarray)):
            z = self.embedding.clip(material)
            new, said = Material(z, np.zeros(3), name="coordinates"), f"{z.tolist()}"
        else:
            raise TypeError(
                "material: expected a library name, a BRDF with an eval method, or coordinates, "
                f"got {material!r}"
            )
        target = repr(part if isinstance(part, str) else names)
        self._do(dict.fromkeys(names, new), f"edit.assign({target}, {said})")

    def _from_reflectance(self, brdf: Reflectance) -> Material:
        grid = self.embedding.grid_
        name = str(getattr(brdf, "name", "")) or type(brdf).__name__
        table = (
            brdf.regrid(grid)
            if isinstance(brdf, TabulatedBRDF)
            else TabulatedBRDF.from_model(brdf, grid, name)
        )
        z = self.embedding.clip(self.embedding.encode(table))
        values = np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)
        return Material(z, table.mirror, self.embedding.residual(table), values, name)

    def move(self, part: str, hold: Iterable[str] = (), **amounts: float) -> None:
        """Change traits of one part: ``edit.move("handle", shiny=0.6, hold=("colour",))``.

        Parameters
        ----------
        part : name
        hold : traits, or the group "colour", whose scores shall stay
        amounts : for each trait, how much its score shall change (1: typically low to high)

        Raises
        ------
        ValueError, TypeError
            On unknown names, amounts that are not finite, or holds that forbid the move. Nothing
            is changed then.
        """
        if not amounts:
            raise ValueError("amounts: expected at least one trait, as in shiny=0.6; got none")
        hold = (hold,) if isinstance(hold, str) else tuple(hold)
        new = self._moved(part, amounts, hold)
        said = "".join(f", {name}={float(value)!r}" for name, value in amounts.items())
        held = f", hold={hold!r}" if hold else ""
        self._do({part: new}, f"edit.move({part!r}{said}{held})")

    def _moved(self, part: str, amounts: Mapping[str, float], hold: Iterable[str]) -> Material:
        old = self.material(part)
        z = self.traits.move(old.z, amounts, hold)
        if np.array_equal(z, old.z):
            return old
        return replace(old, z=z, table=None)

    def paint(self, stroke: Stroke) -> dict[str, float]:
        """Paint a trait on the image: every part under the stroke moves by its share of it.

        Parameters
        ----------
        stroke : Stroke, in pixels of this scene's image

        Returns
        -------
        dict of the amount by which each touched part was moved

        Raises
        ------
        ValueError
            If the stroke touches no part, or the trait is unknown. Nothing is changed then.
        """
        if not isinstance(stroke, Stroke):
            raise TypeError(f"stroke: expected a Stroke, got {stroke!r}")
        self.traits.index(stroke.trait)
        scene = self.scene
        weights = region_weights(
            stroke.coverage(scene.height, scene.width), scene.part_image, len(scene.parts)
        )
        touched = [
            (name, float(weight))
            for name, weight in zip(scene.parts, weights, strict=True)
            if weight > 0.0
        ]
        if not touched:
            raise ValueError(
                "stroke: expected a stroke that touches the object, got one that lies beside it "
                f"(image {scene.width} x {scene.height}, {len(stroke.points)} points)"
            )
        hold = stroke.hold
        if hold is None:
            hold = () if stroke.trait in GROUPS["colour"] else ("colour",)
        moved = {name: stroke.amount * weight for name, weight in touched}
        new = {
            name: self._moved(name, {stroke.trait: amount}, hold) for name, amount in moved.items()
        }
        held = "" if stroke.hold is None else f", hold={tuple(stroke.hold)!r}"
        self._do(
            new,
            f"edit.paint(tb.Stroke({list(stroke.points)!r}, trait={stroke.trait!r}, "
            f"amount={float(stroke.amount)!r}, radius={float(stroke.radius)!r}{held}))",
        )
        return moved

    def _do(self, new: dict[str, Material], call: str) -> None:
        before = {part: self._materials[part] for part in new}
        self._done.append(_Edit(before, new, call))
        self._undone.clear()
        self._materials.update(new)

    def undo(self) -> bool:
        """Take the last edit back; False if there is none."""
        if not self._done:
            return False
        edit = self._done.pop()
        self._materials.update(edit.before)
        self._undone.append(edit)
        return True

    def redo(self) -> bool:
        """Do the last undone edit again; False if there is none."""
        if not self._undone:
            return False
        edit = self._undone.pop()
        self._materials.update(edit.after)
        self._done.append(edit)
        return True

    @property
    def history(self) -> list[str]:
        """The Python calls that made the design, in order; undone ones are not among them."""
        return self._replayed + [edit.call for edit in self._done]

    # -- frames ---------------------------------------------------------------------------------

    def prepare(self) -> Transport:
        """Compress the scene's light transport, unless that is done already."""
        if self._transport is None:
            start = time.perf_counter()
            rank, resolution = QUALITIES[self.quality]
            self._transport = Transport(
                self.scene,
                self.embedding.grid_,
                _training(self.library, self.seed),
                rank=rank,
                resolution=resolution,
                seed=self.seed,
                device=self.device,
                progress=self._progress,
            )
            self._times["prepare"] = time.perf_counter() - start
        return self._transport

    def render(self) -> Float32:
        """The frame (H, W, 3) float32: linear radiance, backdrop included, never negative.

        Parts whose material is the same object as at the last frame are not computed again.
        """
        transport = self.prepare()
        start = time.perf_counter()
        frames = [self._shade(transport, i, part) for i, part in enumerate(self.scene.parts)]
        image = transport.compose(frames)
        result = np.asarray(image.cpu().numpy(), np.float32)
        self._times["frame"] = time.perf_counter() - start
        return result

    def _shade(self, transport: Transport, index: int, part: str) -> PartFrame:
        material = self._materials[part]
        known = self._frames.get(part)
        if known is not None and known[0] is material:
            return known[1]
        values = material.values(self.embedding)
        mirror = torch.from_numpy(material.mirror.astype(np.float32)).to(self.device)
        cells = torch.from_numpy(values[transport.cells]).to(self.device)
        frame, tier = transport.shade(index, cells, mirror), "basis"
        if frame.error > (EXACT_ABOVE if self.error is None else self.error):
            frame, tier = transport.shade_exactly(index, values, mirror), "exact"
        self._frames[part] = material, frame, tier
        return frame

    def report(self) -> dict[str, Any]:
        """What was measured: error, tier, times, sizes, plausibility; JSON serialisable.

        ``frame_error`` is the mean relative L1 on the probe pixels, which keep their exact
        rows, over the whole object; ``parts`` has it part by part, with the tier ("basis" or
        "exact"), the trait scores of its coordinates, ``energy_scale`` (the factor by which the
        table had to be lowered to reflect no more than all light: below 1 it shows less of its
        traits than the scores say), the largest directional albedo and how far the coordinates
        lie inside the gamut box (0 on its wall, 0.5 in its middle, the least coordinate counts).
        """
        if self._transport is None or len(self._frames) < len(self.scene.parts):
            self.render()
        transport = self.prepare()
        parts = {}
        span = np.maximum(self.embedding.high_ - self.embedding.low_, 1e-12)
        for i, part in enumerate(self.scene.parts):
            material = self._materials[part]
            frame = self._shade(transport, i, part)
            inside = (material.z - self.embedding.low_) / span
            parts[part] = {
                "material": material.name,
                "pixels": len(frame.radiance),
                "error": frame.error,
                "tier": self._frames[part][2],
                "scores": self.traits.score(material.z),
                "energy_scale": self._energy_scale(material),
                "max_albedo": self.brdf(part).max_albedo(),
                "gamut_margin": float(np.minimum(inside, 1.0 - inside).min()),
            }
        frames = [self._frames[part][1] for part in self.scene.parts]
        return {
            "quality": self.quality,
            "frame_error": transport.frame_error(frames),
            "seconds": dict(self._times),
            "image": [self.scene.height, self.scene.width],
            "covered_pixels": len(self.scene.pixels),
            "basis_images": transport.rank,
            "cells_seen": len(transport.cells),
            "cells": self.embedding.grid_.size,
            "bytes": transport.bytes,
            "device": str(self.device),
            "clipped_texels": self.scene.environment.clipped_texels,
            "parts": parts,
            "history": self.history,
        }

    # -- files ----------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write the design (scene, light, materials, history) to one file; atomic.

        The file holds arrays and JSON only; a loaded design renders the identical frame. What was
        undone is not kept.
        """
        scene = self.scene
        arrays: dict[str, NDArray[Any]] = {"environment": scene.environment.image}
        if isinstance(scene.shape, Mesh):
            mesh = scene.shape
            shape: dict[str, Any] = {"kind": "mesh", "parts": list(mesh.parts)}
            for name in ("vertices", "faces", "normals", "face_part"):
                arrays[f"shape_{name}"] = np.asarray(getattr(mesh, name))
        elif isinstance(scene.shape, Sphere):
            shape = {
                "kind": "sphere",
                "radius": float(scene.shape.radius),
                "center": np.asarray(scene.shape.center).tolist(),
            }
        else:
            raise TypeError(f"save: expected a sphere or a mesh, got {scene.shape!r}")
        materials = []
        for i, part in enumerate(scene.parts):
            material = self._materials[part]
            arrays[f"z_{i}"], arrays[f"mirror_{i}"] = material.z, material.mirror
            for name in ("offset", "table"):
                value = getattr(material, name)
                if value is not None:
                    arrays[f"{name}_{i}"] = value
            materials.append({"part": part, "name": material.name})
        header = {
            "format": _FORMAT,
            "embedding": _fingerprint(self.embedding),
            "shape": shape,
            "size": [scene.height, scene.width],
            "camera": vars(scene.camera),
            "rotation": scene.environment.rotation,
            "clipped_texels": scene.environment.clipped_texels,
            "lights": [{"kind": type(light).__name__, **vars(light)} for light in scene.lights],
            "materials": materials,
            "history": self.history,
            "quality": self.quality,
            "error": self.error,
            "seed": self.seed,
        }
        arrays["design"] = np.array(json.dumps(header))
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> EditSession:
        """Read a design written by `save`; `settings` are passed to `EditSession`.

        Raises
        ------
        FileNotFoundError, traitbrdf.formats.FormatError
            Also if the design was made with another embedding than the one at hand: its
            coordinates would mean other materials.
        """
        arrays = read_arrays(path)
        with _design_errors(path):
            header = json.loads(str(arrays["design"]))
            if header["format"] != _FORMAT:
                raise FormatError(path, f"a design of format {_FORMAT}", f"{header['format']!r}")
            scene = _saved_scene(header, arrays)
            given = {key: header[key] for key in ("quality", "error", "seed")}
            cls(scene, **given)  # what is wrong in the file is no mistake of the caller
        session = cls(scene, **{**given, **settings})
        with _design_errors(path):
            expected = _fingerprint(session.embedding)
            if header["embedding"] != expected:
                raise FormatError(
                    path, f"a design of embedding {expected}", f"embedding {header['embedding']}"
                )
            named = [entry["part"] for entry in header["materials"]]
            if named != list(scene.parts):
                raise FormatError(path, f"materials of {list(scene.parts)}", f"{named}")
            for i, entry in enumerate(header["materials"]):
                session._materials[entry["part"]] = _saved_material(
                    i, str(entry["name"]), arrays, session.embedding
                )
            session._replayed = [str(call) for call in header["history"]]
        return session


@contextlib.contextmanager
def _design_errors(path: str | PathLike[str]) -> Iterator[None]:
    """Whatever does not fit while a design is read is the file's fault."""
    try:
        yield
    except FormatError:
        raise
    except (
        KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError
    ) as error:  # fmt: skip
        raise FormatError(path, "a design written by EditSession.save", repr(error)) from error


def _saved_scene(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Scene:
    shape = header["shape"]
    made: Mesh | Sphere
    if shape["kind"] == "mesh":
        vertices, faces, normals, face_part = (
            arrays[f"shape_{name}"] for name in ("vertices", "faces", "normals", "face_part")
        )
        made = Mesh(vertices, faces, normals, face_part, tuple(shape["parts"]))
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
    return Scene(made, environment, lights, Camera(**header["camera"]), (height, width))


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


@functools.lru_cache(maxsize=1)
def _training(library: Library, seed: int) -> Training:
    """The training set of a library; kept, since every new view or light needs it again."""
    channels = [library.embedding.decode_values(z) for z in library.coordinates]
    return training_tables(np.concatenate(channels, axis=1), library.embedding.grid_, seed)


def _fingerprint(embedding: BRDFEmbedding) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(embedding.arrays().items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:16]
