"""Preparing a view behind, with progress, and taking turns."""

from __future__ import annotations

import atexit
import contextlib
import functools
import itertools
import math
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.session.budget import QUALITIES, TRUSTED, Promise, keep
from traitbrdf.session.cache import Cache, cache_key, fixed_key
from traitbrdf.session.canvas import Canvas
from traitbrdf.session.settings import Settings
from traitbrdf.space.library import Library
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace
from traitbrdf.transport.basis import Training, training_tables
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import light_tree
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]

EXACT_ABOVE = 0.01
"""The error that every shown part has to meet by its own measurement, if none is asked for."""

SMALL_PART = 0.1
"""Of parts that are a smaller share of the shape's pixels more error is borne, up to three times
as much: it is lost in the frame's, and an exact frame would take a thousand times as long."""

TRAINED_MEMBERS = 400
"""Members of the library that a basis is fitted to: more of them span little more."""

DRAFT_SIZE = 128
"""Pixels along the longer side of a draft."""

_CALIBRATED = 96
"""Materials that a promise is measured on."""

_STRAY = 0.4
"""How far half of them are from a member of the library, in widths of the box."""

_FAREWELL = 20.0  # seconds that the interpreter's end waits for a cancelled preparation


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


TURNS = _Turns()


class LightTrees:
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
class Prepared:
    """A transport, whether it came from the cache, the materials of the parts that it was prepared
    for no others of (by index), itself before it was cut down for a promise, and the promise."""

    transport: Transport
    cached: bool
    fixed: Mapping[int, Material]
    whole: Transport
    promise: Promise | None = None


class Preparation:
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
        work: Callable[[Progress], Prepared],
        publish: Callable[[Preparation, Prepared], None],
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
        TURNS.wake()

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
                TURNS.give(self)
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
        TURNS.take(self, False, lambda: self.stopped or self._wanted() is None)

    def _told(self, stage: str, fraction: float) -> None:
        self.fraction = max(self.fraction, min(fraction, 0.99))
        # others take their turns here, and what is called may compute as well
        TURNS.give(self)
        if self._progress is not None and not self.stopped:
            self._progress(stage, fraction)
        self._take()


_RUNNING: weakref.WeakSet[Preparation] = weakref.WeakSet()


@atexit.register
def _end_preparations() -> None:
    """Threads that are cut off inside compiled code would take the process down with them."""
    running = list(_RUNNING)
    for job in running:
        job.stop()
    for job in running:
        job.done.wait(_FAREWELL)


def trusted_error(scene: Scene, part: int, asked: float | None = None) -> float:
    """The measured error up to which a session shows a part by the basis."""
    span = scene.part_slice(part)
    shape = scene.part_slice(len(scene.shape.parts) - 1).stop
    share = max(span.stop - span.start, 1) / max(shape, 1)
    error = EXACT_ABOVE if asked is None else asked
    return TRUSTED * error * min(max(1.0, math.sqrt(SMALL_PART / share)), 3.0)


def timed(call: Callable[[], object], device: torch.device) -> float:
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


def prepare_view(
    scene: Scene,
    settings: Settings,
    library: Library,
    traits: TraitSpace,
    cache: Cache | None,
    fixed: Mapping[int, Material],
    known: Transport | None,
    report: Progress,
) -> Prepared:
    """The transport of a scene, for edits of all parts but those that are `fixed`, as large as a
    promise of error or speed needs; what is `known` of it need not be computed again."""
    report("compiling", 0.0)
    traits.reach(library.coordinates[0], {traits.names[0]: 0.1})  # else the first stroke waits
    prepared = _transport(scene, settings, library, cache, fixed, known, report)
    if settings.quality == "reference" or (settings.error is None and settings.fps is None):
        return prepared
    report("measuring", 1.0)
    return promised(prepared, library, settings)


def promised(prepared: Prepared, library: Library, settings: Settings) -> Prepared:
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
    canvas, turn = Canvas(whole), itertools.cycle(some)

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
    transport, promise = keep(
        whole, stacked, borne, frame, settings.quality, dimensions, settings.error, settings.fps
    )
    return replace(prepared, transport=transport, promise=promise)


def _transport(
    scene: Scene,
    settings: Settings,
    library: Library,
    cache: Cache | None,
    fixed: Mapping[int, Material],
    known: Transport | None,
    report: Progress,
) -> Prepared:
    """The transport of a scene with all images of a quality, computed or read."""
    rank, resolution = QUALITIES[settings.quality]
    seed, device = settings.seed, settings.place
    grid = library.embedding.grid_
    tables = {part: material.values(library.embedding) for part, material in fixed.items()}
    key = None
    if cache is not None:
        whole = cache_key(scene, library, rank, resolution, seed)
        # one that serves all edits serves these as well
        for some in ({}, fixed) if fixed else ({},):
            key = fixed_key(whole, {part: tables[part] for part in some})
            arrays = None if key is None else cache.read(key)
            if key is None or arrays is None:
                continue
            try:
                transport = Transport.restored(scene, grid, arrays, device)
            except ValueError:  # written by something else
                cache.drop(key)
            else:
                report("reading", 1.0)
                return Prepared(transport, True, some, transport)
    report("tables", 0.0)
    training = training_of(library, seed)
    report("tables", 0.0)
    if known is None:
        training = replace(training, fixed=tables)
        transport = Transport(scene, grid, training, rank, resolution, seed, device, report)
    else:
        transport = known.freed(training, seed, report)
    if cache is not None and key is not None:
        cache.write_behind(key, transport.arrays())
    return Prepared(transport, False, fixed, transport)


def trained_members(library: Library) -> list[int]:
    """Which members of a library bases are fitted to: `TRAINED_MEMBERS` of them, evenly spread."""
    # neighbours of the recipe are of different families: any even choice has them all
    return sorted({int(i) for i in np.linspace(0, len(library) - 1, TRAINED_MEMBERS)})


@functools.lru_cache(maxsize=1)
def training_of(library: Library, seed: int) -> Training:
    """The training set of a library; kept, since every new view or light needs it again."""
    channels = [
        library.embedding.decode_values(library.coordinates[i]) for i in trained_members(library)
    ]
    return training_tables(np.concatenate(channels, axis=1), library.embedding.grid_, seed)
