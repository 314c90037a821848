"""Preparation of a view: in the background, with progress, one at a time."""

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

from traitbrdf.design.effects import Palette
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.session.budget import QUALITIES, TRUSTED, Promise, keep
from traitbrdf.session.cache import Cache, cache_key, fixed_key, universal_key
from traitbrdf.session.canvas import Canvas
from traitbrdf.session.settings import Settings
from traitbrdf.space.library import Library
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace
from traitbrdf.transport.basis import Training, training_tables
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import light_tree
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.universal import UniversalBasis
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]

EXACT_ABOVE = 0.01
"""The error that every shown part has to meet by its own measurement, if none is asked for."""

SMALL_PART = 0.1
"""A part that covers a smaller share of the shape's pixels may err more, up to three times as much:
the frame's error hardly changes, and an exact frame would take a thousand times as long."""

TRAINED_MEMBERS = 400
"""Members of the library that a basis is fitted to; more members span little more."""

NODES = (1000, 4000)
"""Numbers of nodes, one after the other, that show edits until a view is prepared."""

DRAFT_SIZE = 128
"""Pixels along the longer side of a draft."""

UNIVERSAL = ("preview", "interactive")
"""Qualities whose bases are made of the universal tables; others combine tables for each scene."""

_KEPT = ("tables", "projection", "need", "typical")
"""What is kept of a universal basis."""

_CALIBRATED = 96
"""Materials on which a promise is measured."""

_STRAY = 0.4
"""Distance of half of them from a member of the library, in widths of the gamut box."""

_FAREWELL = 20.0  # seconds for which the interpreter, at its end, waits for a preparation


class StoppedError(Exception):
    """Raised within a preparation that was cancelled."""


class Turns:
    """Lets heavy work run one at a time, urgent work first.

    Two jobs at once would only slow each other down, and some of numba's threading layers do not
    allow two threads in parallel loops.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._owner: object = None
        self._urgent = 0

    def take(self, owner: object, urgent: bool, stopped: Callable[[], bool]) -> None:
        """Wait for a turn.

        Parameters
        ----------
        owner : object
            Who takes it.
        urgent : bool
            Whether somebody waits for the result: urgent work goes first.
        stopped : callable
            Whether to give up; it is asked again at each `wake`.

        Raises
        ------
        StoppedError
            As soon as `stopped()` is true.
        """
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
                raise StoppedError
            self._owner = owner

    def give(self, owner: object) -> None:
        """End the owner's turn, if it has one."""
        with self._change:
            if self._owner is owner:
                self._owner = None
                self._change.notify_all()

    def wake(self) -> None:
        """Have all who wait ask again whether they should stop."""
        with self._change:
            self._change.notify_all()

    @contextlib.contextmanager
    def urgent(self) -> Iterator[None]:
        """Take an urgent turn for a block of code."""
        owner = object()
        self.take(owner, True, lambda: False)
        try:
            yield
        finally:
            self.give(owner)


TURNS = Turns()
"""The turns of this process."""


class LightTrees:
    """Keeps the light tree of the map in use; a map that is only rotated has the same tree."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._image: Float32 | None = None
        self._tree: LightTree | None = None

    def of(self, environment: EnvironmentMap) -> LightTree:
        """Return the light tree of a map."""
        with self._lock:
            if self._tree is None or self._image is not environment.image:
                self._tree, self._image = light_tree(environment), environment.image
            return self._tree


@dataclass(frozen=True)
class Prepared:
    """A prepared transport.

    Attributes
    ----------
    transport : Transport
        What frames are made with.
    cached : bool
        Whether it was read from the cache.
    fixed : mapping of part index to Material
        Parts that were prepared for this one material.
    whole : Transport
        With all basis images, before some were left out for a promise.
    promise : Promise or None
    """

    transport: Transport
    cached: bool
    fixed: Mapping[int, Material]
    whole: Transport
    promise: Promise | None = None


class Preparation:
    """One run of a view's preparation, in the thread that calls `run`.

    Parameters
    ----------
    work : callable
        Prepares; it is given a function to report progress to.
    publish : callable
        Is given this object and what was prepared.
    progress : callable or None
        Is told of each stage and fraction.
    wanted : callable
        Returns None once nobody needs the result.

    Attributes
    ----------
    done : threading.Event
        Set once the run has ended, successfully or not.
    stopped : bool
        Whether it was cancelled.
    error : BaseException or None
        What it failed with.
    fraction : float
        Share that is done; it never falls.
    thread : threading.Thread or None
        Where it runs.
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
        """Whether it was cancelled."""
        return self._stop.is_set()

    def stop(self) -> None:
        """Cancel the run; it ends at its next report of progress."""
        self._stop.set()
        TURNS.wake()

    def start(self) -> None:
        """Run in the background, in a thread that does not keep the interpreter from ending."""
        self.thread = threading.Thread(target=self.run, name="traitbrdf-prepare", daemon=True)
        _RUNNING.add(self)
        try:
            self.thread.start()
        except RuntimeError as error:  # no more threads: who waits for it must not wait for ever
            self.error = error
            self.done.set()

    def run(self) -> None:
        """Prepare and publish; errors are kept in `error`."""
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
        except StoppedError:
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
    """Stop what runs: a thread that is killed inside compiled code crashes the process."""
    running = list(_RUNNING)
    for job in running:
        job.stop()
    for job in running:
        job.done.wait(_FAREWELL)


def trusted_error(scene: Scene, part: int, asked: float | None = None) -> float:
    """Return the measured error up to which a session shows a part by the basis.

    Parameters
    ----------
    scene : Scene
    part : int
        Index of the part.
    asked : float or None
        Error asked for; None is `EXACT_ABOVE`.
    """
    span = scene.part_slice(part)
    shape = scene.part_slice(len(scene.shape.parts) - 1).stop
    share = max(span.stop - span.start, 1) / max(shape, 1)
    error = EXACT_ABOVE if asked is None else asked
    return TRUSTED * error * min(max(1.0, math.sqrt(SMALL_PART / share)), 3.0)


def timed(call: Callable[[], object], device: torch.device) -> float:
    """Return the least time of three calls, in seconds.

    Parameters
    ----------
    call : callable
    device : torch.device
        It is synchronised before a time is taken.
    """
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
    palette: Palette,
    cache: Cache | None,
    fixed: Mapping[int, Material],
    known: Transport | None,
    begin: Callable[[Progress], None],
    report: Progress,
) -> Prepared:
    """Prepare a scene for edits.

    Parameters
    ----------
    scene : Scene
    settings : Settings
        A promise of error or speed decides how many basis images are used.
    palette : Palette
        What the scene is edited with.
    cache : Cache or None
    fixed : mapping of part index to Material
        Parts that are not edited, and their materials.
    known : Transport or None
        An earlier preparation of the scene with fewer parts free; it is extended.
    begin : callable
        Is called, to show something meanwhile, if the scene is not in the cache.
    report : callable
        Is told of each stage and fraction.
    """
    report("compiling", 0.0)
    library = palette.library

    def begin_and_compile(report: Progress) -> None:
        begin(report)
        _compile_behind(palette)

    prepared = _transport(scene, settings, library, cache, fixed, known, begin_and_compile, report)
    if prepared.cached:
        _compile_behind(palette)
    if settings.quality == "reference" or (settings.error is None and settings.fps is None):
        return prepared
    report("measuring", 1.0)
    return promised(prepared, library, settings)


def compile_moves(library: Library, traits: TraitSpace) -> None:
    """Compile the code that moves run, or load it; otherwise the first stroke would.

    Parameters
    ----------
    library : Library
    traits : TraitSpace
    """
    traits.reach(library.coordinates[0], {traits.names[0]: 0.1})


def _compile_behind(palette: Palette) -> None:
    """Compile moves in a thread, once there are first images.

    Numba compiles one function at a time, so that images would wait for moves that come first. The
    interpreter waits for the thread when it ends.
    """
    moves = functools.partial(compile_moves, palette.library, palette.traits)
    with contextlib.suppress(RuntimeError):  # the interpreter is ending
        threading.Thread(target=moves, name="traitbrdf-compile", daemon=False).start()


def promised(prepared: Prepared, library: Library, settings: Settings) -> Prepared:
    """Leave out the basis images that a promise of error or speed does not need.

    Parameters
    ----------
    prepared : Prepared
    library : Library
        Some of its members are measured.
    settings : Settings
    """
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
    begin: Callable[[Progress], None],
    report: Progress,
) -> Prepared:
    """Compute the transport with all basis images of a quality, or read it from the cache."""
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
    begin(report)
    report("tables", 0.0)
    if settings.quality in UNIVERSAL:
        basis = universal_basis(library, seed, cache, report)
        training = Training(basis.tables, basis.need.astype(np.float64), combined=True)
    else:
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
    """Return the indices of `TRAINED_MEMBERS` members, evenly spread, that bases are fitted to."""
    # neighbours of the recipe are of different families: any even choice has them all
    return sorted({int(i) for i in np.linspace(0, len(library) - 1, TRAINED_MEMBERS)})


@functools.lru_cache(maxsize=1)
def training_of(library: Library, seed: int) -> Training:
    """Return the training set of a library; it is kept, since every view and light needs it."""
    channels = [
        library.embedding.decode_values(library.coordinates[i]) for i in trained_members(library)
    ]
    return training_tables(np.concatenate(channels, axis=1), library.embedding.grid_, seed)


def universal_basis(
    library: Library, seed: int, cache: Cache | None, report: Progress
) -> UniversalBasis:
    """Return the universal basis of a library: from the cache, or fitted and put there.

    Parameters
    ----------
    library : Library
    seed : int
    cache : Cache or None
        None keeps it for this process alone.
    report : callable
        Is told of each stage and fraction.
    """
    grid = library.embedding.grid_
    if cache is not None:
        key = universal_key(library, seed)
        arrays = cache.read(key) or {}
        with contextlib.suppress(KeyError):  # missing, or written by something else
            return UniversalBasis(grid, *(arrays[name] for name in _KEPT))
    report("universal basis", 0.0)
    training = training_of(library, seed)
    known = [basis for made_of, basis in _FITTED if made_of is training]
    if not known:
        known = [UniversalBasis.fit(grid, training, seed=seed, progress=report)]
        _FITTED[:] = [(training, known[0])]
    if cache is not None:
        cache.write_behind(key, {name: getattr(known[0], name) for name in _KEPT})
    return known[0]


_FITTED: list[tuple[Training, UniversalBasis]] = []
"""The universal basis that was fitted last, and what it was fitted to."""
