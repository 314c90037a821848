"""EditSession: materials on the parts of a scene, edited by traits and shown at once.

Every part (region) of the shape has one material: coordinates in the embedding, and, where a
table or a model was assigned, what that table has beyond the manifold, which edits keep. All
edits are undone and redone one at a time; a stroke is one edit.

*Views.* Camera, light and size are not part of the materials: `EditSession.look` changes them.
What is prepared for one view lies in one object (`_View`) that the next look replaces as a whole,
so that no frame of an old view can turn up later.

*Threads.* A preparation may run behind (`prepare(wait=False)`). It works on what it was given,
publishes its result in one step under the session's lock, and stops at its next sign of progress
when it is cancelled. Heavy work takes turns (`_Turns`): drafts and exact frames, which somebody
waits for, go first.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import importlib.metadata
import itertools
import json
import math
import os
import sys
import threading
import time
import weakref
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import Reflectance, TabulatedBRDF
from traitbrdf.embedding import BRDFEmbedding, Library, default_library
from traitbrdf.formats import FormatError, atomic_path, read_arrays, unknown_name, write_arrays
from traitbrdf.lights import DirectionalLight, EnvironmentMap, Light, LightTree, PointLight
from traitbrdf.promises import QUALITIES, TRUSTED, Promise, keep, quality_for
from traitbrdf.quadrature import light_tree
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import Mesh, Sphere, sphere
from traitbrdf.strokes import Stroke, region_weights
from traitbrdf.traits import Move, Trait, TraitSpace, default_traits
from traitbrdf.transport import (
    AnglesSeen,
    Draft,
    PartFrame,
    Progress,
    Training,
    Transport,
    angles_seen,
    training_tables,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

EXACT_ABOVE = 0.01
"""The error that every shown part has to meet by its own measurement, if none is asked for."""

SMALL_PART = 0.1
"""Of parts that are a smaller share of the shape's pixels more error is borne, up to three times
as much: it is lost in the frame's, and an exact frame would take a thousand times as long."""

TRAINED_IMAGES = 8
"""At most so many exact images are taken into a basis."""

TRAINED_MEMBERS = 400
"""Members of the library that a basis is fitted to: more of them span little more."""

DRAFT_SIZE = 128
"""Pixels along the longer side of a draft."""

FRAMES_KEPT = 1 << 27
"""Bytes of finished parts that are kept, so that what is undone is shown again as it was."""

_CALIBRATED = 96
"""Materials that a promise is measured on."""

_STRAY = 0.4
"""How far half of them are from a member of the library, in widths of the box."""

CACHE_BYTES = 2_000_000_000
"""Preparations on disk take at most so many bytes, unless TRAITBRDF_CACHE_BYTES says otherwise."""

_FORMAT = 2
_CACHE_FORMAT = 2
_FIRST_MATERIAL = "white-plastic"
_FIRST_GROUND = "concrete"
_TICK = 0.2  # seconds between two looks at how far a preparation has come
_FAREWELL = 20.0  # seconds that the interpreter's end waits for a cancelled preparation


@dataclass(frozen=True, eq=False)
class Material:
    """What one part is made of; equal if it is the same reflectance, of the same name.

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

    @functools.cached_property
    def _key(self) -> tuple[object, ...]:
        # tables are large: one that was assigned anew is another
        return self.name, id(self.table), id(self.offset), self.z.tobytes(), self.mirror.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Material) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def values(self, embedding: BRDFEmbedding, cells: Int64 | None = None) -> Float32:
        """f_r (n, 3) at `cells` (n,) of the embedding's grid; at all of them if left out."""
        if self.table is not None:
            whole = self.table
        elif cells is None or 2 * len(cells) > embedding.grid_.size:
            # the energy check reads most of the grid: of many cells, all come as fast
            whole = embedding.decode_values(self.z, self.offset)
        else:
            return embedding.decode_values(self.z, self.offset, cells)
        return whole if cells is None else whole.take(cells, axis=0)


@dataclass(frozen=True)
class _Said:
    """The call that did an edit.

    A stroke lies on the image: where the picture has been framed anew since, `anywhere` says the
    same part by part. It is put into words when it is asked for: while it is painted, nobody does.
    """

    call: str | Callable[[], str]
    anywhere: str = ""
    framing: tuple[Camera, int, int] | None = None

    def under(self, framing: tuple[Camera, int, int]) -> str:
        if self.anywhere and framing != self.framing:
            return self.anywhere
        return self.call if isinstance(self.call, str) else self.call()


@dataclass(frozen=True)
class _Edit:
    """One undoable step: the materials before and after, and the call that did it."""

    before: dict[str, Material]
    after: dict[str, Material]
    said: _Said


@dataclass(frozen=True)
class _Shown:
    """One part's shading as it is shown, how it was made, and what that took."""

    frame: PartFrame
    tier: Literal["basis", "trained", "exact"]
    seconds: float


class _StopError(Exception):
    """Raised through a preparation that was cancelled."""


class _Turns:
    """Who computes: heavy work comes one after the other, what somebody waits for first.

    Two at once would only slow each other down, and where numba has no better threading layer its
    loops must not be entered by two threads.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._owner: object = None
        self._urgent = 0

    def take(self, owner: object, urgent: bool, stopped: Callable[[], bool]) -> None:
        """Wait for a turn; `_StopError` as soon as `stopped()`, looked at upon `wake`."""
        with self._change:
            self._urgent += urgent
            try:
                self._change.wait_for(
                    lambda: stopped() or (self._owner is None and (urgent or not self._urgent))
                )
            finally:
                self._urgent -= urgent
                self._change.notify_all()
            if stopped():
                raise _StopError
            self._owner = owner

    def give(self, owner: object) -> None:
        """End the owner's turn; nothing happens if it has none."""
        with self._change:
            if self._owner is owner:
                self._owner = None
                self._change.notify_all()

    def wake(self) -> None:
        with self._change:
            self._change.notify_all()

    @contextlib.contextmanager
    def urgent(self) -> Iterator[None]:
        """A turn for what somebody waits for."""
        owner = object()
        self.take(owner, True, lambda: False)
        try:
            yield
        finally:
            self.give(owner)


_TURNS = _Turns()


class _LightTrees:
    """The light tree of the map in use; turning a map leaves its tree as it is."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._image: Float32 | None = None
        self._tree: LightTree | None = None

    def of(self, environment: EnvironmentMap) -> LightTree:
        with self._lock:
            if self._tree is None or self._image is not environment.image:
                self._tree, self._image = light_tree(environment), environment.image
            return self._tree


@dataclass(frozen=True)
class _Prepared:
    """A transport, whether it came from the cache, the materials of the parts that it was prepared
    for no others of (by index), itself before it was cut down for a promise, and the promise."""

    transport: Transport
    cached: bool
    fixed: Mapping[int, Material]
    whole: Transport
    promise: Promise | None = None


class _Preparation:
    """One run of a view's preparation, in whatever thread calls `run`.

    Attributes
    ----------
    done : set once it has ended, well or not
    stopped : whether it was cancelled
    error : what it failed with
    fraction : how much is done, never falling
    thread : where it runs
    """

    def __init__(
        self,
        work: Callable[[Progress], _Prepared],
        publish: Callable[[_Preparation, _Prepared], None],
        progress: Progress | None,
        wanted: Callable[[], object],
    ) -> None:
        self.done = threading.Event()
        self.error: BaseException | None = None
        self.fraction = 0.0
        self.seconds = 0.0
        self.thread: threading.Thread | None = None
        self._work = work
        self._publish = publish
        self._progress = progress
        self._wanted = wanted
        self._stop = threading.Event()

    @property
    def stopped(self) -> bool:
        return self._stop.is_set()

    def stop(self) -> None:
        """End it at its next sign of progress."""
        self._stop.set()
        _TURNS.wake()

    def start(self) -> None:
        """Run behind. The thread does not keep the interpreter from ending."""
        self.thread = threading.Thread(target=self.run, name="traitbrdf-prepare", daemon=True)
        _RUNNING.add(self)
        self.thread.start()

    def run(self) -> None:
        self.thread = threading.current_thread()
        start = time.perf_counter()
        try:
            self._take()
            try:
                prepared = self._work(self._told)
            finally:
                _TURNS.give(self)
            self.seconds = time.perf_counter() - start
            self._publish(self, prepared)
        except _StopError:
            pass
        except BaseException as error:  # also an interruption: whoever waits raises it
            self.error = error
        finally:
            self.done.set()

    def _take(self) -> None:
        # nobody waits for the preparation of a session that is gone
        _TURNS.take(self, False, lambda: self.stopped or self._wanted() is None)

    def _told(self, stage: str, fraction: float) -> None:
        self.fraction = max(self.fraction, min(fraction, 0.99))
        # others take their turns here, and what is called may compute as well
        _TURNS.give(self)
        if self._progress is not None and not self.stopped:
            self._progress(stage, fraction)
        self._take()


_RUNNING: weakref.WeakSet[_Preparation] = weakref.WeakSet()


@atexit.register
def _end_preparations() -> None:
    """Threads that are cut off inside compiled code would take the process down with them."""
    running = list(_RUNNING)
    for job in running:
        job.stop()
    for job in running:
        job.done.wait(_FAREWELL)


class _Canvas:
    """The frame on the device, of which only the pixels of changed parts are drawn again.

    A pixel at a border is the sum of the backdrop and its parts, in the order of the parts, each
    time it is drawn: so the image depends on nothing but the parts' frames.
    """

    def __init__(self, transport: Transport) -> None:
        scene = transport.scene
        self._transport = transport
        sizes = [0 if part is None else len(part.pixels) for part in transport.parts]
        black = [PartFrame(torch.zeros(n, 3, device=transport.device), 0.0, 0.0) for n in sizes]
        self._backdrop = transport.compose(black).reshape(-1, 3)
        several = np.bincount(scene.pixels, minlength=len(scene.uncovered)) > 1
        # the share of the pixel that shows the backdrop is a part of the sum as well
        self._mixed = (several | (scene.uncovered > 0.0))[scene.pixels]
        self._patches: dict[int | None, tuple[torch.Tensor, list[Any]]] = {}
        self.drawn: list[PartFrame] = []
        self._copies: list[Float32] = []
        self._image = self._backdrop
        self.changed: list[int] = []

    def draw(self, frames: list[PartFrame]) -> None:
        """Bring the image up to the parts' frames; `changed` are those that were drawn."""
        drawn, self.drawn = self.drawn, []  # what is cut off half way is drawn as a whole again
        if drawn:
            pairs = zip(frames, drawn, strict=True)
            self.changed = [i for i, (new, old) in enumerate(pairs) if new is not old]
            self.redraw(self.changed, frames)
        else:
            self.changed = list(range(len(frames)))
            self._image = self._transport.compose(frames).reshape(-1, 3)
        self.drawn = frames

    def redraw(self, changed: list[int], frames: list[PartFrame]) -> None:
        """Draw the pixels of the parts `changed`."""
        for i in changed:
            part = self._transport.parts[i]
            if part is not None:
                self._image.index_copy_(0, part.pixels, frames[i].radiance)
        if changed:
            pixels, places = self._patch(changed[0] if len(changed) == 1 else None)
            sums = self._backdrop[pixels]
            for i, fragments, place in places:
                sums.index_add_(0, place, frames[i].radiance[fragments])
            self._image.index_copy_(0, pixels, sums)

    def _patch(self, part: int | None) -> tuple[torch.Tensor, list[Any]]:
        """Pixels that are sums and show `part` (None: any), and what falls on which of them."""
        if part not in self._patches:
            scene = self._transport.scene
            chosen = self._mixed.copy()
            if part is not None:
                chosen &= scene.pixel_part == part
            pixels = np.unique(scene.pixels[chosen])
            places = []
            for i in range(len(scene.parts)):
                span = scene.part_slice(i)
                fragments = np.flatnonzero(np.isin(scene.pixels[span], pixels))
                if len(fragments):
                    place = np.searchsorted(pixels, scene.pixels[span][fragments])
                    places.append((i, self._tensor(fragments), self._tensor(place)))
            self._patches[part] = self._tensor(pixels), places
        return self._patches[part]

    def _tensor(self, index: Int64) -> torch.Tensor:
        return torch.from_numpy(index).to(self._transport.device)

    def image(self) -> Float32:
        """A copy (H, W, 3) of the frame."""
        scene = self._transport.scene
        # new pages cost ten times the copy: those of a frame that nobody holds are used again
        for copy in self._copies:
            if sys.getrefcount(copy) == 3:  # the list, this loop and the question itself
                break
        else:
            copy = np.empty((scene.height, scene.width, 3), np.float32)
            self._copies = [copy, *self._copies[:2]]
        copy[...] = self._image.cpu().numpy().reshape(copy.shape)
        return copy


class _Drafted(NamedTuple):
    """A draft's image (h, w, 3) and measured error, and of what it is."""

    size: int
    materials: tuple[Material, ...]
    image: Float32
    error: float


@dataclass(eq=False)
class _View:
    """All that belongs to one scene of the session: the next look replaces it as a whole."""

    scene: Scene
    job: _Preparation | None = None
    prepared: _Prepared | None = None
    canvas: _Canvas | None = None
    shown: list[_Shown] = field(default_factory=list)
    kept: OrderedDict[tuple[int, Material], _Shown] = field(default_factory=OrderedDict)
    kept_bytes: int = 0
    trained: dict[int, int] = field(default_factory=dict)
    budget: dict[int, int] = field(default_factory=dict)
    floor: dict[int, float] = field(default_factory=dict)
    exact_frames: int = 0
    draft: tuple[int, Draft] | None = None
    drafted: _Drafted | None = None
    times: dict[str, float] = field(default_factory=dict)

    def keep(self, index: int, material: Material, shown: _Shown) -> None:
        """Keep a part's shading, the least recently used ones going first."""
        old = self.kept.pop((index, material), None)
        self.kept_bytes -= 0 if old is None else _size(old)
        self.kept[index, material] = shown
        self.kept_bytes += _size(shown)
        while self.kept_bytes > FRAMES_KEPT and len(self.kept) > len(self.scene.parts):
            _, old = self.kept.popitem(last=False)
            self.kept_bytes -= _size(old)


def _size(shown: _Shown) -> int:
    return shown.frame.radiance.numel() * shown.frame.radiance.element_size()


def trusted_error(scene: Scene, part: int, asked: float | None = None) -> float:
    """The measured error up to which a session shows a part by the basis."""
    span = scene.part_slice(part)
    shape = scene.part_slice(len(scene.shape.parts) - 1).stop
    share = max(span.stop - span.start, 1) / max(shape, 1)
    error = EXACT_ABOVE if asked is None else asked
    return TRUSTED * error * min(max(1.0, math.sqrt(SMALL_PART / share)), 3.0)


class EditSession:
    """Materials of a scene's parts, edited by traits, rendered in real time.

    Parameters
    ----------
    scene : Scene
    quality : "preview", "interactive", "accurate", "reference" or None
        None is what `error` needs, "interactive" without one. "reference" shows exact frames
        alone, which take seconds.
    error : float or None
        The mean relative L1 that every shown part has to meet by its own measurement (a part
        smaller than a tenth of the shape up to three times as much); parts that do not are
        rendered without the basis, which takes seconds, and taught to it. Of the basis as few
        images are used as 95 % of materials need for it: the more error, the faster. None is
        0.01, and all images.
    fps : float or None
        Frames a second that an edit of the whole object shall reach on this machine: so many
        images of the basis are used, and no frame is exact. The error that it costs is measured
        and reported. Not together with `error`.
    library, embedding, traits : what to edit with; None is what the package ships
    device : torch device for frames
    seed : int, of the preparation's random choices
    progress : called with (stage, fraction) while the scene is prepared, from the thread that
        prepares; may raise to cancel
    cache : bool
        Whether finished preparations are kept on disk: in $TRAITBRDF_CACHE or the user's cache
        folder, the least recently used ones going beyond 2 GB ($TRAITBRDF_CACHE_BYTES; 0 is off).

    Notes
    -----
    The scene is prepared at the first `render` (or by `prepare`), behind if asked for; `draft`
    gives a first image at once. Every method may be called from any thread.
    """

    def __init__(
        self,
        scene: Scene,
        quality: str | None = None,
        error: float | None = None,
        fps: float | None = None,
        library: Library | None = None,
        traits: TraitSpace | None = None,
        device: str | torch.device = "cpu",
        seed: int = 0,
        progress: Progress | None = None,
        cache: bool = True,
    ) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a Scene, got {scene!r}")
        for name, asked in (("error", error), ("fps", fps)):
            if asked is not None and not (math.isfinite(asked) and asked > 0.0):
                raise ValueError(f"{name}: expected a positive number, got {asked!r}")
        if error is not None and fps is not None:
            raise ValueError(f"expected error or fps, got both: error={error!r}, fps={fps!r}")
        quality = quality_for(error) if quality is None else quality
        if quality not in QUALITIES:
            raise ValueError(unknown_name("quality", quality, tuple(QUALITIES)))
        self.quality = quality
        self.error = error
        self.fps = fps
        self.library = default_library() if library is None else library
        self.embedding = self.library.embedding
        self.traits = default_traits() if traits is None else traits
        self.device = torch.device(device)
        self.seed = seed
        self._progress = progress
        self._cache = _Cache.usual() if cache else None
        self._trees = _LightTrees()
        self._lock = threading.RLock()
        self._view = _View(scene)
        self._edited: set[str] = set()  # parts that a preparation has to serve all edits of
        first = self._first(_FIRST_MATERIAL)
        self._materials = dict.fromkeys(scene.parts, first)
        if scene.ground:
            self._materials[scene.parts[-1]] = self._first(_FIRST_GROUND)
        self._done: list[_Edit] = []
        self._undone: list[_Edit] = []
        self._replayed: list[_Said] = []
        self._reached: dict[str, Move] = {}

    def __repr__(self) -> str:
        return f"EditSession({self.scene!r}, quality={self.quality!r}, {len(self._done)} edits)"

    @property
    def scene(self) -> Scene:
        """What is looked at; `look` replaces it."""
        return self._view.scene

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

    def plausibility(self, part: str) -> dict[str, float]:
        """How far a part's material can be believed, as `report` has it: ``energy_scale``,
        ``gamut_margin`` and ``plausibility``."""
        material = self.material(part)
        span = np.maximum(self.embedding.high_ - self.embedding.low_, 1e-12)
        inside = (material.z - self.embedding.low_) / span
        return {
            "energy_scale": self._energy_scale(material),
            "gamut_margin": float(np.minimum(inside, 1.0 - inside).min()),
            "plausibility": self.traits.plausibility(material.z),
        }

    def _energy_scale(self, material: Material) -> float:
        if material.table is not None:  # shown as it came
            return 1.0
        return self.embedding.energy_scale(material.z, material.offset)

    def _first(self, name: str) -> Material:
        return self._from_library(name if name in self.library else self.library.names[0])

    def _from_library(self, name: str) -> Material:
        z = self.library.coordinates[self.library.index(name)]
        return Material(self.embedding.clip(z), np.zeros(3), name=name)

    def _names(self, part: str | Iterable[str]) -> list[str]:
        names = [part] if isinstance(part, str) else list(part)
        if not names:
            raise ValueError("part: expected at least one name, got none")
        for name in names:
            self.part(name)
        return names

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
        names = self._names(part)
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
        self._do(dict.fromkeys(names, new), _Said(f"edit.assign({target}, {said})"))

    def _from_reflectance(self, brdf: Reflectance) -> Material:
        grid = self.embedding.grid_
        name = str(getattr(brdf, "name", "")) or type(brdf).__name__
        table = (
            brdf.regrid(grid)
            if isinstance(brdf, TabulatedBRDF)
            else TabulatedBRDF.from_model(brdf, grid, name)
        )
        z = self.embedding.encode(table)
        values = np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)
        return Material(z, table.mirror, self.embedding.residual(table, z), values, name)

    def move(
        self,
        part: str | Iterable[str],
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        **amounts: float,
    ) -> None:
        """Change traits of parts: ``edit.move("handle", shiny=0.6)``.

        Parameters
        ----------
        part : name or names of parts
        hold : what shall stay: traits, "colour", "lightness", "body"; () is nothing
            None is what `TraitSpace.holds` says: colour, unless a trait is a colour itself, and
            lightness, unless one is about that.
        photoreal : whether to stay where materials of the library are near; `plausibility` says
            how far a material is from that
        amounts : for each trait, how much its score shall change (1: typically low to high)

        Where less is reached, the furthest is shown, and `reached` says how far that is, and why.

        Raises
        ------
        ValueError, TypeError
            On unknown names, amounts that are not finite, or holds that forbid the move. Nothing
            is changed then.
        """
        if not amounts:
            raise ValueError("amounts: expected at least one trait, as in shiny=0.6; got none")
        names = self._names(part)
        if hold is not None:
            hold = (hold,) if isinstance(hold, str) else tuple(hold)
        with self._lock:
            # parts of one material stay so: they are decoded once
            old = {name: self.material(name) for name in names}
            moved = {m: self._moved(m, amounts, hold, photoreal) for m in old.values()}
            new = {name: moved[old[name]][0] for name in names}
            reached = {name: moved[old[name]][1] for name in names}
            target = part if isinstance(part, str) else names
            self._edited.update(new)
            self._do(new, _Said(_move_call(target, amounts, hold, photoreal)), reached)

    def _moved(
        self,
        old: Material,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None,
        photoreal: bool = True,
    ) -> tuple[Material, Move]:
        found = self.traits.moved(old.z, amounts, hold, photoreal)
        if np.array_equal(found.z, old.z):
            return old, found
        return replace(old, z=found.z, table=None), found

    def reached(self, part: str) -> Move | None:
        """What the last move or stroke came to on a part, while it is the last edit; else None."""
        self.part(part)
        return self._reached.get(part)

    def add_trait(self, trait: Trait) -> None:
        """Paint and move with a trait of one's own; it is saved with the design."""
        with self._lock:
            self.traits = self.traits.with_trait(trait, self.library)

    def paint(self, stroke: Stroke, only: str | Iterable[str] | None = None) -> dict[str, float]:
        """Paint a trait on the image: every part under the stroke moves by its share of it.

        Parameters
        ----------
        stroke : Stroke, in pixels of this scene's image
        only : part or parts that may move, as if there were no others; None is all

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
        with self._lock:
            scene = self.scene
            region = scene.part_image
            if only is not None:
                only = (only,) if isinstance(only, str) else tuple(only)
                free = [self.part(name) for name in only]
                region = np.where(np.isin(region, free), region, -1)
            weights = region_weights(
                stroke.coverage(scene.height, scene.width), region, len(scene.parts)
            )
            moved = {
                name: stroke.amount * float(weight)
                for name, weight in zip(scene.parts, weights, strict=True)
                if weight > 0.0
            }
            if not moved:
                raise ValueError(
                    "stroke: expected a stroke that touches the object, got one that lies beside "
                    f"it (image {scene.width} x {scene.height}, {len(stroke.points)} points)"
                )
            hold = None if stroke.hold is None else tuple(stroke.hold)
            found = {
                name: self._moved(self.material(name), {stroke.trait: amount}, hold)
                for name, amount in moved.items()
            }
            new = {name: material for name, (material, _) in found.items()}
            reached = {name: move for name, (_, move) in found.items()}
            held = "" if hold is None else f", hold={hold!r}"
            alone = ""
            if only is not None:
                alone = f", only={(only[0] if len(only) == 1 else only)!r}"
            self._edited.update(new)
            self._do(new, _Said(
                lambda: f"edit.paint(tb.Stroke({list(stroke.points)!r}, trait={stroke.trait!r}, "
                f"amount={float(stroke.amount)!r}, radius={float(stroke.radius)!r}{held}){alone})",
                "; ".join(_move_call(name, {stroke.trait: a}, hold) for name, a in moved.items()),
                _framing(scene),
            ), reached)  # fmt: skip
        return moved

    def _do(
        self, new: dict[str, Material], said: _Said, reached: dict[str, Move] | None = None
    ) -> None:
        with self._lock:
            before = {part: self._materials[part] for part in new}
            self._done.append(_Edit(before, new, said))
            self._undone.clear()
            self._materials.update(new)
            self._reached = {} if reached is None else reached

    def undo(self) -> bool:
        """Take the last edit back; False if there is none."""
        with self._lock:
            if not self._done:
                return False
            edit = self._done.pop()
            self._materials.update(edit.before)
            self._undone.append(edit)
            self._reached = {}
            return True

    def redo(self) -> bool:
        """Do the last undone edit again; False if there is none."""
        with self._lock:
            if not self._undone:
                return False
            edit = self._undone.pop()
            self._materials.update(edit.after)
            self._done.append(edit)
            self._reached = {}
            return True

    @property
    def last(self) -> object:
        """The last edit, to tell whether another has come since; None if there is none."""
        return self._done[-1] if self._done else None

    @property
    def undoable(self) -> bool:
        """Whether there is an edit to undo."""
        return bool(self._done)

    @property
    def redoable(self) -> bool:
        """Whether there is an undone edit to do again."""
        return bool(self._undone)

    @property
    def history(self) -> list[str]:
        """The Python calls that made the design, in order; undone ones are not among them.

        They replay it on this session's present scene: strokes that were painted on the image of
        another camera or size appear as the moves that they were.
        """
        with self._lock:
            framing = _framing(self.scene)
            said = [*self._replayed, *(edit.said for edit in self._done)]
            return [one.under(framing) for one in said]

    # -- view and light -------------------------------------------------------------------------

    def look(
        self,
        camera: Camera | None = None,
        environment: EnvironmentMap | None = None,
        lights: Sequence[Light] | None = None,
        size: int | tuple[int, int] | None = None,
        rotation: float | None = None,
    ) -> None:
        """Change the view or the light; what is None stays. Materials and undo stay as well.

        A preparation that runs is cancelled; the next `render` prepares the new view.

        Parameters
        ----------
        camera : Camera
        environment : EnvironmentMap
        lights : the point and directional lights, all of them
        size : int or (height, width)
        rotation : radians
            Angle by which the map is turned about +y (`EnvironmentMap.rotation`).

        Raises
        ------
        ValueError, TypeError
            As `Scene` does. Nothing is changed then.
        """
        with self._lock:
            scene = self.scene
            light = scene.environment if environment is None else environment
            if not isinstance(light, EnvironmentMap):
                raise TypeError(f"environment: expected an EnvironmentMap, got {light!r}")
            if rotation is not None:
                clipped = light.clipped_texels
                light = EnvironmentMap(light.image, rotation)
                light.clipped_texels = clipped
            wanted: dict[str, Any] = {}
            if light.image is not scene.environment.image or (
                light.rotation != scene.environment.rotation
            ):
                wanted["environment"] = light
            if camera is not None and camera != scene.camera:
                wanted["camera"] = camera
            if lights is not None and tuple(lights) != scene.lights:
                wanted["lights"] = lights
            if size is not None:
                pair = tuple(size) if isinstance(size, (tuple, list)) else (size, size)
                if pair != (scene.height, scene.width):
                    wanted["size"] = size
            if not wanted:
                return
            old, self._view = self._view, _View(scene.changed(**wanted))
            if old.job is not None:
                old.job.stop()

    # -- frames ---------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether the present view is prepared: `render` then takes milliseconds."""
        return self._serving(self._view) is not None

    def _serving(self, view: _View) -> Transport | None:
        """The view's transport, if it is prepared and can show the present materials."""
        known = view.prepared
        if known is None:
            return None
        for index, material in known.fixed.items():
            part = view.scene.parts[index]
            if part in self._edited or self._materials[part] != material:
                return None
        return known.transport

    @overload
    def prepare(self, wait: Literal[True] = True) -> Transport: ...

    @overload
    def prepare(self, wait: bool) -> Transport | None: ...

    def prepare(self, wait: bool = True) -> Transport | None:
        """Compress the scene's light transport, unless that is done already.

        A ground that nobody edits is prepared for its material alone; the first edit of it has
        the rest done.

        Parameters
        ----------
        wait : bool
            False starts the preparation in a thread behind, unless one runs, and returns at once.

        Returns
        -------
        The prepared transport; None while it is not ready (only if `wait` is False).

        Raises
        ------
        concurrent.futures.CancelledError
            If it was cancelled by another thread while this one waited.
        RuntimeError
            If the `progress` callback waits for the preparation that called it.
        Exception
            What a preparation that ran behind failed with, once; the next call tries again.
        """
        while True:
            with self._lock:
                view, job = self._view, self._view.job
                transport = self._serving(view)
                if transport is not None:
                    return transport
                fresh = job is None
                if job is None:
                    job = view.job = self._new_job(view)
                elif job.error is not None:
                    view.job = None
            if fresh and not wait:
                job.start()
            elif fresh:
                job.run()
            if job.error is not None:
                with self._lock:
                    if view.job is job:
                        view.job = None
                raise job.error
            if not wait:
                return None
            if job.thread is threading.current_thread() and not job.done.is_set():
                raise RuntimeError("prepare: expected another thread than that of the preparation")
            job.done.wait()
            if job.stopped and self._view is view and self._serving(view) is None:
                raise CancelledError("the preparation was cancelled")

    def _new_job(self, view: _View) -> _Preparation:
        # neither of these holds the session: a session that nobody needs any more can go
        lock = self._lock

        def publish(job: _Preparation, prepared: _Prepared) -> None:
            with lock:
                known = view.prepared
                if known is None or len(known.fixed) > len(prepared.fixed):
                    view.prepared, view.canvas = prepared, None
                    view.times["prepare"] = job.seconds
                if view.job is job:
                    view.job = None

        scene, fixed = view.scene, {}
        if scene.ground and scene.parts[-1] not in self._edited and view.prepared is None:
            fixed[len(scene.parts) - 1] = self._materials[scene.parts[-1]]
        known = None if view.prepared is None else view.prepared.whole
        work = functools.partial(
            _prepare, scene, self.library, self.traits, self.quality, self.error, self.fps,
            self.seed, self.device, self._cache, fixed, known,
        )  # fmt: skip
        return _Preparation(work, publish, self._progress, weakref.ref(self))

    def cancel(self) -> None:
        """Stop a preparation that runs, soon; the session goes on as if it had not begun."""
        with self._lock:
            job = self._view.job
            if job is not None and not job.done.is_set():
                self._view.job = None
                job.stop()

    def draft(self, size: int | None = None) -> tuple[Float32, float]:
        """A first image at once, without any preparation.

        It is rendered at a small size and enlarged; the first one of a view takes longer than those
        after it.

        Parameters
        ----------
        size : int
            Pixels along the longer side of what is rendered; None is 128.

        Returns
        -------
        image : (H, W, 3) float32 linear radiance, backdrop included
        error : float
            Mean relative L1 over the small image's covered pixels, measured at some of them.
        """
        size = DRAFT_SIZE if size is None else size
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ValueError(f"size: expected a positive number of pixels, got {size!r}")
        while True:
            with self._lock:
                view = self._view
                scene = view.scene
                materials = tuple(self._materials[part] for part in scene.parts)
            known = view.drafted
            if known is None or known.size != size or known.materials != materials:
                with _TURNS.urgent():
                    known = view.drafted = self._draft(view, materials, size)
            if view is self._view:  # else it is a picture of what was looked at before
                return _enlarged(known.image, scene.height, scene.width), known.error

    def _draft(self, view: _View, materials: tuple[Material, ...], size: int) -> _Drafted:
        start = time.perf_counter()
        if view.draft is None or view.draft[0] != size:
            tree = self._trees.of(view.scene.environment)
            grid = self.embedding.grid_
            view.draft = size, Draft(view.scene, grid, size, tree=tree, seed=self.seed)
        tables = {m: m.values(self.embedding) for m in materials}
        image, error = view.draft[1].render(
            [tables[m] for m in materials], [m.mirror for m in materials]
        )
        view.times["draft"] = time.perf_counter() - start
        return _Drafted(size, materials, image, error)

    def render(self, wait: bool = True, exact: bool = True) -> Float32:
        """The frame (H, W, 3) float32: linear radiance, backdrop included, never negative.

        Parts whose material is that of a recent frame are not computed again, and
        only the pixels of those that changed are drawn. The array is the caller's.

        Parameters
        ----------
        wait : bool
            False returns the draft while the view is not prepared, and has it prepared behind.
        exact : bool
            False shows by the basis what it cannot promise as well, within milliseconds:
            `doubtful` names those parts then, and `frame_error` has what was measured.

        Raises
        ------
        As `prepare` does.
        """
        while not wait:
            with self._lock:
                view = self._view
                transport = self._serving(view)
                if transport is not None:
                    return self._frame(view, transport, exact)
            image, _ = self.draft()
            if self.prepare(wait=False) is None:
                return image
        with self._prepared() as (view, transport):
            return self._frame(view, transport, exact)

    @property
    def doubtful(self) -> list[str]:
        """Parts of the last frame whose measured error is more than the basis is trusted with."""
        with self._lock:
            view = self._view
            return [
                view.scene.parts[i]
                for i, one in enumerate(view.shown)
                if one.tier != "exact" and one.frame.error > self._allowed(view, i)
            ]

    def before(self) -> Float32:
        """The frame (H, W, 3) as it would be without this session's edits; nothing is changed."""
        # a ground that was assigned had another material before
        self._edited.update(*(edit.before for edit in self._done))
        with self._prepared() as (view, transport):
            now = dict(self._materials)
            for edit in reversed(self._done):
                self._materials.update(edit.before)
            try:
                return self._frame(view, transport, exact=False)
            finally:
                self._materials = now

    @property
    def frame_error(self) -> float | None:
        """Mean relative L1 of the last frame by its own measurement; None before the first."""
        with self._lock:
            view = self._view
            known = view.prepared
            return _measured(view, known.transport) if known is not None and view.shown else None

    def frames(self) -> Iterator[tuple[Float32, float, float]]:
        """Images that get better: the draft, then the finished frame.

        Yields (image, error, fraction): the image and its error as `draft` has them, again
        whenever the preparation has come on or a material has changed; at last the frame and its
        measured error, with a fraction of 1. Closing the generator cancels the preparation, and
        cancelling the preparation ends the generator.

        Examples
        --------
        >>> for image, error, fraction in edit.frames():  # doctest: +SKIP
        ...     show(image, f"{fraction:.0%}, error {error:.2%}")
        """
        view, job = self._view, None
        try:
            while not self.ready:
                image, error = self.draft()
                yield image, error, 0.0 if job is None else job.fraction
                with self._lock:
                    if self._view is not view:  # what was begun for the old view is void
                        view, job = self._view, None
                    if job is not None and job.stopped:
                        return
                    self.prepare(wait=False)
                    job = view.job or job
                if job is not None:
                    job.done.wait(_TICK)
            with self._prepared() as (view, transport):
                image, error = self._frame(view, transport), _measured(view, transport)
            yield image, error, 1.0
        finally:
            if not self.ready:
                self.cancel()

    @contextlib.contextmanager
    def _prepared(self) -> Iterator[tuple[_View, Transport]]:
        """The lock, held once the present view is ready: never while it is waited for."""
        while True:
            self.prepare()
            with self._lock:
                view = self._view
                transport = self._serving(view)
                if transport is not None:
                    yield view, transport
                    return

    def _frame(self, view: _View, transport: Transport, exact: bool = True) -> Float32:
        start = time.perf_counter()
        tables: dict[Material, torch.Tensor] = {}
        materials = [self._materials[part] for part in view.scene.parts]
        wanted = Counter(m for i, m in enumerate(materials) if (i, m) not in view.kept)
        shown = [
            self._shade(view, transport, i, material, tables, wanted[material] == 1, exact)
            for i, material in enumerate(materials)
        ]
        if view.canvas is None:
            view.canvas = _Canvas(transport)
        view.canvas.draw([one.frame for one in shown])
        view.shown = shown
        image = view.canvas.image()
        view.times["frame"] = time.perf_counter() - start
        return image

    def _shade(
        self,
        view: _View,
        transport: Transport,
        index: int,
        material: Material,
        tables: dict[Material, torch.Tensor],
        alone: bool,
        exact: bool,
    ) -> _Shown:
        """One part's shading; `tables` holds what was decoded for this frame, and `alone` says
        that only this part wants its material's. Unless `exact`, the basis has the last word."""
        known = view.kept.get((index, material))
        if known is not None and not (
            exact and known.tier != "exact" and known.frame.error > self._allowed(view, index)
        ):
            view.kept.move_to_end((index, material))
            return known
        start = time.perf_counter()
        if material not in tables:
            values = material.values(self.embedding, transport.cells)
            tables[material] = torch.from_numpy(values).to(self.device)
        mirror = None
        if material.mirror.any():
            mirror = torch.from_numpy(material.mirror.astype(np.float32)).to(self.device)
        frame = transport.shade(index, tables[material], mirror, alone)
        tier: Literal["basis", "trained", "exact"] = "basis"
        part = transport.parts[index]
        if part is not None and part.group in view.budget:
            tier = "trained"
        if exact and frame.error > self._allowed(view, index):
            frame, tier = self._exactly(view, transport, index, material, mirror), "exact"
            tables.clear()  # the transport may see other cells by now
        shown = _Shown(frame, tier, time.perf_counter() - start)
        view.keep(index, material, shown)
        return shown

    def _allowed(self, view: _View, index: int) -> float:
        """The measured error up to which a part is shown by the basis."""
        if self.quality == "reference":
            return -1.0
        if self.fps is not None:
            return math.inf
        # nothing is gained by exact frames that err as much
        allowed = trusted_error(view.scene, index, self.error)
        return max(allowed, view.floor.get(index, 0.0)) if self.error is None else allowed

    def _exactly(
        self,
        view: _View,
        transport: Transport,
        index: int,
        material: Material,
        mirror: torch.Tensor | None,
    ) -> PartFrame:
        """A part without the basis; its image is taken into the basis for the edits to come."""
        values = material.values(self.embedding)
        part = transport.parts[index]
        with _TURNS.urgent():
            frame = transport.shade_exactly(index, values)
            if frame.error > trusted_error(view.scene, index):
                view.floor[index] = max(view.floor.get(index, 0.0), 1.2 * frame.error)
            allowed = self._allowed(view, index)
            budget = 0 if part is None else view.budget.get(part.group, TRAINED_IMAGES)
            # where even exact frames miss the error asked for, the basis cannot meet it
            if part is not None and budget > 0 and frame.error <= allowed:
                transport.train(index, frame.radiance)
                table = torch.from_numpy(values[transport.cells]).to(self.device)
                met = transport.shade(index, table).error <= allowed
                view.trained[index] = view.trained.get(index, 0) + 1
                # each image makes all frames slower: few of those that do not help
                view.budget[part.group] = budget - (1 if met else TRAINED_IMAGES // 2)
        view.exact_frames += 1
        if mirror is None or part is None:
            return frame
        return replace(frame, radiance=frame.radiance + mirror * part.mirror)

    # -- gradients ------------------------------------------------------------------------------

    def radiance(self, part: str, z: torch.Tensor) -> torch.Tensor:
        """A part's linear radiance as a differentiable function of coordinates.

        Parameters
        ----------
        part : name
        z : (k,) tensor, float32 or float64

        Returns
        -------
        (P, 3) float32 tensor on the session's device: what the part would add to its pixels (see
        `gradient` for which) if its coordinates were `z`, by the basis and not clamped at 0. What
        an assigned table has beyond the manifold, and a mirror beside it, stay.
        """
        index, material = self.part(part), self.material(part)
        self._edited.add(part)
        with self._prepared() as (_, transport):
            table = self.embedding.decode_tensor(z, material.offset, transport.cells)
            shown = transport.radiance(index, table.to(self.device, torch.float32))
            known = transport.parts[index]
            if known is None or not material.mirror.any():
                return shown
            mirror = torch.from_numpy(material.mirror.astype(np.float32)).to(self.device)
            return shown + mirror * known.mirror

    def gradient(self, part: str) -> tuple[Int64, Float32]:
        """Derivative of the linear frame by a part's coordinates, in closed form.

        Returns
        -------
        pixels : (P,) int64
            Flat indices (row * width + column) of the pixels that show the part.
        slopes : (P, 3, k) float32
            d radiance / d z of each pixel and colour: of what `radiance` gives at the part's
            present coordinates.
        """
        index, material = self.part(part), self.material(part)
        self._edited.add(part)
        with self._prepared() as (view, transport):
            slopes = self.embedding.jacobian(material.z, material.offset, transport.cells)
            columns = torch.from_numpy(slopes).to(self.device).permute(2, 0, 1)
            # radiance is linear in the table: all coordinates in one product
            moved = torch.vmap(lambda table: transport.radiance(index, table))(columns)
            pixels = view.scene.pixels[view.scene.part_slice(index)].copy()
        return pixels, moved.permute(1, 2, 0).contiguous().cpu().numpy()

    # -- reports --------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """What was measured: error, tier, times, sizes, plausibility; JSON serialisable.

        ``frame_error`` is the mean relative L1 on the probe pixels, which keep their exact
        rows, over all covered pixels; ``parts`` has it part by part, with the tier, the trait
        scores of its coordinates, ``energy_scale`` (the factor by which the table had to be
        lowered to reflect no more than all light: below 1 it shows less of its traits than the
        scores say), the largest directional albedo and how far the coordinates lie inside the
        gamut box (0 on its wall, 0.5 in its middle, the least coordinate counts), and the share
        of the library that is less plausible (``plausibility``). ``move`` says what the last edit
        asked of a part and what it came to.

        Tiers: "basis"; "trained", the same after exact images were taken into the part's basis;
        "exact", without the basis. ``exact_frames`` counts those, ``trained_images`` what the
        bases have taken in.

        ``promise`` is what was picked for the error or the speed that was asked for, and what that
        measured (`traitbrdf.promises.Promise`).

        ``left_out`` is what the frame did not need, and what that saved where it is measured: here
        and now, both ways. A frame is rendered (and the scene prepared) if that is to be done.
        """
        with self._prepared() as (view, transport):
            materials = [self._materials[part] for part in view.scene.parts]
            fresh = len(view.shown) < len(materials) or any(
                view.kept.get((i, m)) is not view.shown[i] for i, m in enumerate(materials)
            )
            if fresh:
                self._frame(view, transport)
            scene = view.scene
            parts = {}
            for i, (part, material) in enumerate(zip(scene.parts, materials, strict=True)):
                parts[part] = self._part_report(part, material, view.shown[i])
            prepared = view.prepared
            return {
                "quality": self.quality,
                "promise": None
                if prepared is None or prepared.promise is None
                else prepared.promise.as_dict(),
                "frame_error": _measured(view, transport),
                "error_asked": EXACT_ABOVE if self.error is None else self.error,
                "seconds": dict(view.times),
                "prepared_from": "cache" if prepared is not None and prepared.cached else "scratch",
                "image": [scene.height, scene.width],
                "covered_pixels": int(np.count_nonzero(scene.uncovered < 1.0)),
                "fragments": len(scene.pixels),
                "basis_images": transport.rank,
                "exact_frames": view.exact_frames,
                "trained_images": {scene.parts[i]: n for i, n in view.trained.items()},
                "cells_seen": len(transport.cells),
                "cells": self.embedding.grid_.size,
                "bytes": transport.bytes,
                "device": str(self.device),
                "clipped_texels": scene.environment.clipped_texels,
                "left_out": self._left_out(view, transport),
                "parts": parts,
                "history": self.history,
            }

    def angles(self, part: str | None = None) -> AnglesSeen:
        """Which angles of the BRDF of a part (None: of the shape) this scene shows at all.

        What light and view leave out, no edit changes: `traitbrdf.gallery.angle_map` draws it.
        """
        index = None if part is None else self.part(part)
        return angles_seen(self.scene, self.embedding.grid_, index)

    def _part_report(self, part: str, material: Material, shown: _Shown) -> dict[str, Any]:
        return {
            "material": material.name,
            "pixels": len(shown.frame.radiance),
            "error": shown.frame.error,
            "tier": shown.tier,
            "scores": self.traits.score(material.z),
            "max_albedo": self.brdf(part).max_albedo(),
            **self.plausibility(part),
            "move": None if part not in self._reached else str(self._reached[part]),
        }

    def _left_out(self, view: _View, transport: Transport) -> dict[str, Any]:
        """What the last frame did without."""
        scene, canvas = view.scene, view.canvas
        if canvas is None:
            return {}
        frames = [one.frame for one in view.shown]
        changed = canvas.changed
        plain = replace(self._materials[scene.parts[0]], table=None, offset=None)
        drawn = [scene.pixels[scene.part_slice(i)] for i in changed]
        still = [i for i in range(len(scene.parts)) if i not in changed]
        return {
            "shadow_rays": {
                "parts": [
                    part
                    for part, casts in zip(scene.parts, scene.casts, strict=True)
                    if scene.shadows and not casts
                ],
                "rays_cast": scene.rays_cast,
            },
            "cells": {
                "seen": len(transport.cells),
                "of": self.embedding.grid_.size,
                "seconds": _timed(
                    lambda: plain.values(self.embedding, transport.cells), self.device
                ),
                "seconds_for_all": _timed(lambda: plain.values(self.embedding), self.device),
            },
            "edits": {  # that nobody has made: they would need all of the basis images
                "parts": [scene.parts[i] for i in sorted(transport.fixed)],
                "basis_images": min(
                    (b.rank for b in transport.bases if transport.fixed.intersection(b.parts)),
                    default=0,
                ),
                "of": transport.rank,
            },
            "channels": {"computed": 1 if transport.grey else 3, "of": 3},
            "parts_not_edited": {
                "parts": [scene.parts[i] for i in still],
                "seconds_saved": sum(view.shown[i].seconds for i in still),
            },
            "pixels": {
                "redrawn": len(np.unique(np.concatenate(drawn))) if drawn else 0,
                "of": scene.height * scene.width,
                "seconds": _timed(lambda: canvas.redraw(changed, frames), self.device),
                "seconds_for_all": _timed(lambda: transport.compose(frames), self.device),
            },
        }

    # -- files ----------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write the design (present view and light, materials, history) to one file; atomic.

        The file holds arrays and JSON only. A loaded design renders the same frame: bit by bit
        where the parts are shown by the basis as prepared or exactly, within the error asked for
        where the basis was trained meanwhile. What was undone is not kept.
        """
        with self._lock:
            scene = self.scene
            materials = dict(self._materials)
            framing = _framing(scene)
            said = [*self._replayed, *(edit.said for edit in self._done)]
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
            "embedding": _fingerprint(self.embedding),
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
            "quality": self.quality,
            "error": self.error,
            "fps": self.fps,
            "seed": self.seed,
        }
        if self.traits is not default_traits():
            arrays |= {f"traits_{name}": value for name, value in self.traits.arrays().items()}
        arrays["design"] = np.array(json.dumps(header))
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> EditSession:
        """Read a design written by `save`; `settings` are passed to `EditSession`.

        Designs of format 1, before there were shadows, load as they were: without shadows and
        ground, one ray a pixel.

        Raises
        ------
        FileNotFoundError, traitbrdf.formats.FormatError
            Also if the design was made with another embedding than the one at hand: its
            coordinates would mean other materials.
        """
        arrays = read_arrays(path)
        with _design_errors(path):
            header = json.loads(str(arrays["design"]))
            if header["format"] == 1:
                header = {**header, **_BEFORE_SHADOWS, "anywhere": [""] * len(header["history"])}
            elif header["format"] != _FORMAT:
                raise FormatError(
                    path, f"a design of format 1 to {_FORMAT}", f"{header['format']!r}"
                )
            scene = _saved_scene(header, arrays)
            given = {key: header[key] for key in ("quality", "error", "seed")}
            given["fps"] = header.get("fps")
            # what is wrong in the file is no mistake of the caller
            cls(scene, **given, cache=False)
        with _design_errors(path):
            own = {k.removeprefix("traits_"): v for k, v in arrays.items() if "traits_" in k[:7]}
            if own:
                box = default_traits()
                own |= {"low": box.low, "high": box.high}
                given["traits"] = TraitSpace.from_arrays(own)
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
            session._replayed = [
                _Said(str(call), str(anywhere), _framing(scene))
                for call, anywhere in zip(header["history"], header["anywhere"], strict=True)
            ]
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


def _measured(view: _View, transport: Transport) -> float:
    """Error of the frame that was shown last."""
    return transport.frame_error([one.frame for one in view.shown])


def _framing(scene: Scene) -> tuple[Camera, int, int]:
    """Where on the image things lie."""
    return scene.camera, scene.height, scene.width


def _move_call(
    part: str | list[str],
    amounts: Mapping[str, float],
    hold: tuple[str, ...] | None,
    photoreal: bool = True,
) -> str:
    said = "".join(f", {name}={float(value)!r}" for name, value in amounts.items())
    held = "" if hold is None else f", hold={hold!r}"
    freely = "" if photoreal else ", photoreal=False"
    return f"edit.move({part!r}{said}{held}{freely})"


def _enlarged(image: Float32, height: int, width: int) -> Float32:
    """A copy of an image (h, w, 3) at another size, bilinear between pixel centres."""
    if image.shape[:2] == (height, width):
        return image.copy()
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    whole = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear")
    return whole[0].permute(1, 2, 0).contiguous().numpy()


def _timed(call: Callable[[], object], device: torch.device) -> float:
    """Seconds that a call takes: the least of three."""
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return min(seconds)


# -- preparation ----------------------------------------------------------------------------------


def _prepare(
    scene: Scene,
    library: Library,
    traits: TraitSpace,
    quality: str,
    error: float | None,
    fps: float | None,
    seed: int,
    device: torch.device,
    cache: _Cache | None,
    fixed: Mapping[int, Material],
    known: Transport | None,
    report: Progress,
) -> _Prepared:
    """The transport of a scene, for edits of all parts but those that are `fixed`, as large as a
    promise of error or speed needs; what is `known` of it need not be computed again."""
    report("compiling", 0.0)
    traits.reach(library.coordinates[0], {traits.names[0]: 0.1})  # else the first stroke waits
    prepared = _transport(scene, library, quality, seed, device, cache, fixed, known, report)
    if quality == "reference" or (error is None and fps is None):
        return prepared
    report("measuring", 1.0)
    return _promised(prepared, library, quality, error, fps)


def _promised(
    prepared: _Prepared, library: Library, quality: str, error: float | None, fps: float | None
) -> _Prepared:
    """A transport cut down to what a promise of error or speed needs."""
    whole = prepared.whole
    scene, device, cells, embedding = whole.scene, whole.device, whole.cells, library.embedding
    used = set(trained_members(library))
    others = [z for i, z in enumerate(library.coordinates) if i not in used]
    some = [others[i] for i in np.linspace(0, len(others) - 1, _CALIBRATED).astype(int)]
    # edits leave the library: half of the materials are as far from it as two moves of a unit
    rng, span = np.random.default_rng(0), embedding.high_ - embedding.low_
    some[1::2] = [
        np.clip(
            z + _STRAY * span * rng.normal(size=len(z)) / math.sqrt(len(z)),
            embedding.low_, embedding.high_,
        )
        for z in some[1::2]
    ]  # fmt: skip
    tables = [embedding.decode_values(z)[cells].T for z in some]  # (3, cells)
    stacked = torch.from_numpy(np.stack(tables, axis=2).swapaxes(0, 1).copy()).to(device)
    canvas, turn = _Canvas(whole), itertools.cycle(some)

    def frame(transport: Transport) -> Float32:
        """Of an edited material on all parts of the shape."""
        values = Material(next(turn), np.zeros(3)).values(embedding, cells)
        table = torch.from_numpy(values).to(device)
        frames = [transport.shade(i, table) for i in range(len(scene.shape.parts))]
        still = canvas.drawn[len(frames) :]
        if not still:
            still = [transport.shade(i, table) for i in range(len(frames), len(scene.parts))]
        canvas.draw([*frames, *still])
        return canvas.image()

    borne = np.array([trusted_error(scene, i, 1.0) for i in range(len(scene.parts))])
    dimensions = len(some[0])
    transport, promise = keep(whole, stacked, borne, frame, quality, dimensions, error, fps)
    return replace(prepared, transport=transport, promise=promise)


def _transport(
    scene: Scene,
    library: Library,
    quality: str,
    seed: int,
    device: torch.device,
    cache: _Cache | None,
    fixed: Mapping[int, Material],
    known: Transport | None,
    report: Progress,
) -> _Prepared:
    """The transport of a scene with all images of a quality, computed or read."""
    rank, resolution = QUALITIES[quality]
    grid = library.embedding.grid_
    tables = {part: material.values(library.embedding) for part, material in fixed.items()}
    key = None
    if cache is not None:
        whole = _cache_key(scene, library, rank, resolution, seed)
        # one that serves all edits serves these as well
        for some in ({}, fixed) if fixed else ({},):
            key = _fixed_key(whole, {part: tables[part] for part in some})
            arrays = None if key is None else cache.read(key)
            if key is None or arrays is None:
                continue
            try:
                transport = Transport.restored(scene, grid, arrays, device)
            except ValueError:  # written by something else
                cache.drop(key)
            else:
                report("reading", 1.0)
                return _Prepared(transport, True, some, transport)
    report("tables", 0.0)
    training = _training(library, seed)
    report("tables", 0.0)
    if known is None:
        transport = Transport(scene, grid, training, rank, resolution, seed, device, report, tables)
    else:
        transport = known.freed(training, seed, report)
    if cache is not None and key is not None:
        cache.write_behind(key, transport.arrays())
    return _Prepared(transport, False, fixed, transport)


def trained_members(library: Library) -> list[int]:
    """Which members of a library bases are fitted to: `TRAINED_MEMBERS` of them, evenly spread."""
    # neighbours of the recipe are of different families: any even choice has them all
    return sorted({int(i) for i in np.linspace(0, len(library) - 1, TRAINED_MEMBERS)})


@functools.lru_cache(maxsize=1)
def _training(library: Library, seed: int) -> Training:
    """The training set of a library; kept, since every new view or light needs it again."""
    channels = [
        library.embedding.decode_values(library.coordinates[i]) for i in trained_members(library)
    ]
    return training_tables(np.concatenate(channels, axis=1), library.embedding.grid_, seed)


def _fingerprint(embedding: BRDFEmbedding) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(embedding.arrays().items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:16]


def _hash(*values: object) -> str:
    """SHA-256 of arrays and of what has a faithful repr."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


@functools.lru_cache(maxsize=1)
def _code() -> str:
    """A name of what computes: a result must not outlive the code that it came from."""
    try:
        version = importlib.metadata.version("traitbrdf")
    except importlib.metadata.PackageNotFoundError:
        version = ""
    files = sorted(resources.files("traitbrdf").iterdir(), key=lambda file: file.name)
    return _hash(version, *(file.read_bytes() for file in files if file.name.endswith(".py")))


def _cache_key(
    scene: Scene, library: Library, rank: int, resolution: float, seed: int
) -> str | None:
    """A name of all that a preparation depends on; None where that cannot be told."""
    shape = scene.shape
    geometry: tuple[object, ...]
    if type(shape) is Mesh:
        geometry = shape.vertices, shape.faces
    elif type(shape) is Sphere or not any(scene.casts):
        geometry = ()
    else:
        return None  # what casts shadows is known to the shape alone
    return _hash(
        _CACHE_FORMAT, _code(), _fingerprint(library.embedding), library.coordinates,
        rank, resolution, seed, scene.height, scene.width, scene.parts, scene.casts,
        scene.ground, scene.shadows, np.asarray(shape.center), shape.radius, shape.lowest,
        *geometry, scene.environment.image, scene.environment.rotation, scene.lights,
        *(getattr(scene, name) for name in _FRAGMENTS),
        # a mesh that was saved and loaded may differ in the last bit
        *(getattr(scene, name).astype(np.float32) for name in _SAMPLES),
    )  # fmt: skip


def _fixed_key(whole: str | None, fixed: Mapping[int, Float32]) -> str | None:
    """The name of a preparation for the tables of fixed parts, from that of one for all edits."""
    if whole is None or not fixed:
        return whole
    return _hash(whole, *(x for pair in fixed.items() for x in pair))


_FRAGMENTS = ("pixels", "pixel_part", "weights", "bordering", "offsets")
_SAMPLES = ("normals", "views", "positions", "starts")


class _Cache:
    """Finished preparations on disk. A disk that is full, read-only or gone costs nothing but time.

    Parameters
    ----------
    folder : where the files lie; made when the first is written
    limit : bytes that they may take
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder = folder
        self.limit = limit

    @classmethod
    def usual(cls) -> _Cache | None:
        """The one that the environment variables describe; None where there is none."""
        said = os.environ.get("TRAITBRDF_CACHE_BYTES", str(CACHE_BYTES))
        try:
            limit = int(said)
        except ValueError:
            limit = -1
        if limit < 0:
            raise ValueError(f"TRAITBRDF_CACHE_BYTES: expected a number of bytes, got {said!r}")
        if limit == 0:
            return None
        chosen = os.environ.get("TRAITBRDF_CACHE")
        if chosen:
            return cls(Path(chosen), limit)
        standard = os.environ.get("XDG_CACHE_HOME", "")
        if Path(standard).is_absolute():  # as its specification has it, others are ignored
            return cls(Path(standard) / "traitbrdf", limit)
        try:
            return cls(Path.home() / ".cache" / "traitbrdf", limit)
        except RuntimeError:  # a user without a home
            return None

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.npz"

    def read(self, key: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of a key; None where there are none, or none that are whole."""
        path = self._file(key)
        try:
            arrays = read_arrays(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RuntimeError, MemoryError):  # damaged in whatever way
            self.drop(key)
            return None
        with contextlib.suppress(OSError):  # a cache that is only read
            os.utime(path)
        return arrays

    def drop(self, key: str) -> None:
        with contextlib.suppress(OSError):
            self._file(key).unlink(missing_ok=True)

    def write_behind(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write in a thread of its own, so that the first frame need not wait.

        The interpreter's end waits for it: a program that shows one frame would else never fill
        the cache.
        """
        thread = threading.Thread(target=self.write, args=(key, arrays), name="traitbrdf-cache")
        with contextlib.suppress(RuntimeError):  # the interpreter is ending
            thread.start()

    def write(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write the arrays, and remove the least recently used files beyond the limit."""
        if sum(a.nbytes for a in arrays.values()) > self.limit:
            return
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with atomic_path(self._file(key)) as temporary, temporary.open("wb") as file:
                # compressing takes as long as preparing anew
                np.savez(file, **arrays)  # type: ignore[arg-type]
            self._trim()

    def _trim(self) -> None:
        """What a cut-off process left half written goes like all others: by its age."""
        found = [(path.stat(), path) for path in self.folder.glob("*.npz")]
        total = sum(stat.st_size for stat, _ in found)
        for stat, path in sorted(found, key=lambda pair: pair[0].st_mtime_ns):
            if total <= self.limit:
                return
            path.unlink(missing_ok=True)
            total -= stat.st_size
