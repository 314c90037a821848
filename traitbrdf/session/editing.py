"""EditSession: materials on the parts of a scene, edited by traits and shown at once.

Every part (region) of the shape has one material: coordinates in the embedding, and, where a
table or a model was assigned, what that table has beyond the manifold, which edits keep. All
edits are undone and redone one at a time; a stroke is one edit.

*Views.* Camera, light and size are not part of the materials: `EditSession.look` changes them.
What is prepared for one view lies in one object (`View`) that the next look replaces as a whole,
so that no frame of an old view can turn up later.

*Threads.* A preparation may run behind (`prepare(wait=False)`). It works on what it was given,
publishes its result in one step under the session's lock, and stops at its next sign of progress
when it is cancelled. Heavy work takes turns (`TURNS`): drafts and exact frames, which somebody
waits for, go first.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import replace
from os import PathLike
from typing import Any, Literal, Unpack, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from traitbrdf.design.strokes import Stroke, region_weights
from traitbrdf.formats.files import (
    unknown_name,
)
from traitbrdf.reflectance.brdf import Reflectance, TabulatedBRDF
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap, Light
from traitbrdf.scene.scene import Scene
from traitbrdf.session.budget import quality_for
from traitbrdf.session.cache import Cache
from traitbrdf.session.frames import (
    Drafted,
    Edit,
    Said,
    View,
    enlarged,
    framing_of,
    measured,
    move_call,
)
from traitbrdf.session.preparation import (
    DRAFT_SIZE,
    EXACT_ABOVE,
    TURNS,
    LightTrees,
    Preparation,
    Prepared,
    prepare_view,
)
from traitbrdf.session.rendering import Renderer
from traitbrdf.session.report import part_report, view_report
from traitbrdf.session.settings import Asked, Settings
from traitbrdf.session.storage import Stored, write_design
from traitbrdf.space.learning import Trait
from traitbrdf.space.library import Library, default_library
from traitbrdf.space.material import Material
from traitbrdf.space.moves import Moved
from traitbrdf.space.traits import TraitSpace, default_traits
from traitbrdf.transport.angles import AnglesSeen, angles_seen
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
_FIRST_MATERIAL = "white-plastic"
_FIRST_GROUND = "concrete"
_TICK = 0.2  # seconds between two looks at how far a preparation has come


class EditSession:
    """Materials of a scene's parts, edited by traits, rendered in real time.

    Parameters
    ----------
    scene : Scene
    quality, **asked : what is asked for: error, fps, device, seed, cache; see `Settings`
        A quality of None is what `error` needs, "interactive" without one.
    library, traits : what to edit with; None is what the package ships
    progress : called with (stage, fraction) while the scene is prepared, from the thread that
        prepares; may raise to cancel

    Attributes
    ----------
    settings : Settings, what was asked for

    Raises
    ------
    TypeError, ValueError
        On something that is no scene, or as `Settings` does.

    Notes
    -----
    The scene is prepared at the first `render` (or by `prepare`), behind if asked for; `draft`
    gives a first image at once. Every method may be called from any thread.
    """

    def __init__(
        self,
        scene: Scene,
        quality: str | None = None,
        *,
        library: Library | None = None,
        traits: TraitSpace | None = None,
        progress: Progress | None = None,
        **asked: Unpack[Asked],
    ) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a Scene, got {scene!r}")
        quality = quality_for(asked.get("error")) if quality is None else quality
        self.settings = Settings(quality, **asked)
        self.library = default_library() if library is None else library
        self.embedding = self.library.embedding
        self.traits = default_traits() if traits is None else traits
        self._progress = progress
        self._cache = Cache.usual() if self.settings.cache else None
        self._trees = LightTrees()
        self._lock = threading.RLock()
        self._view = View(scene)
        self._edited: set[str] = set()  # parts that a preparation has to serve all edits of
        first = self._first(_FIRST_MATERIAL)
        self._materials = dict.fromkeys(scene.parts, first)
        if scene.ground:
            self._materials[scene.parts[-1]] = self._first(_FIRST_GROUND)
        self._done: list[Edit] = []
        self._undone: list[Edit] = []
        self._replayed: list[Said] = []
        self._reached: dict[str, Moved] = {}

    def __repr__(self) -> str:
        return f"EditSession({self.scene!r}, quality={self.quality!r}, {len(self._done)} edits)"

    @property
    def quality(self) -> str:
        """Of `settings`."""
        return self.settings.quality

    @property
    def error(self) -> float | None:
        """Of `settings`."""
        return self.settings.error

    @property
    def fps(self) -> float | None:
        """Of `settings`."""
        return self.settings.fps

    @property
    def device(self) -> torch.device:
        """Of `settings`."""
        return self.settings.place

    @property
    def seed(self) -> int:
        """Of `settings`."""
        return self.settings.seed

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
            "energy_scale": material.energy_scale(self.embedding),
            "gamut_margin": float(np.minimum(inside, 1.0 - inside).min()),
            "plausibility": self.traits.plausibility(material.z),
        }

    def _first(self, name: str) -> Material:
        known = name if name in self.library else self.library.names[0]
        return Material.of_library(known, self.library)

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
            new, said = Material.of_library(material, self.library), repr(material)
        elif callable(getattr(material, "eval", None)):
            new = Material.of_reflectance(material, self.embedding)  # type: ignore[arg-type]
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
        self._do(dict.fromkeys(names, new), Said(f"edit.assign({target}, {said})"))

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
            self._do(new, Said(move_call(target, amounts, hold, photoreal)), reached)

    def _moved(
        self,
        old: Material,
        amounts: Mapping[str, float],
        hold: Iterable[str] | None,
        photoreal: bool = True,
    ) -> tuple[Material, Moved]:
        found = self.traits.moved(old.z, amounts, hold, photoreal)
        if np.array_equal(found.z, old.z):
            return old, found
        return replace(old, z=found.z, table=None), found

    def reached(self, part: str) -> Moved | None:
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
            self._do(new, Said(
                lambda: f"edit.paint(tb.Stroke({list(stroke.points)!r}, trait={stroke.trait!r}, "
                f"amount={float(stroke.amount)!r}, radius={float(stroke.radius)!r}{held}){alone})",
                "; ".join(move_call(name, {stroke.trait: a}, hold) for name, a in moved.items()),
                framing_of(scene),
            ), reached)  # fmt: skip
        return moved

    def _do(
        self, new: dict[str, Material], said: Said, reached: dict[str, Moved] | None = None
    ) -> None:
        with self._lock:
            before = {part: self._materials[part] for part in new}
            self._done.append(Edit(before, new, said))
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
            framing = framing_of(self.scene)
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
            old, self._view = self._view, View(scene.changed(**wanted))
            if old.job is not None:
                old.job.stop()

    # -- frames ---------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether the present view is prepared: `render` then takes milliseconds."""
        return self._serving(self._view) is not None

    def _serving(self, view: View) -> Transport | None:
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

    def _new_job(self, view: View) -> Preparation:
        # neither of these holds the session: a session that nobody needs any more can go
        lock = self._lock

        def publish(job: Preparation, prepared: Prepared) -> None:
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
            prepare_view, scene, self.settings, self.library, self.traits, self._cache, fixed, known
        )  # fmt: skip
        return Preparation(work, publish, self._progress, weakref.ref(self))

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
                with TURNS.urgent():
                    known = view.drafted = self._draft(view, materials, size)
            if view is self._view:  # else it is a picture of what was looked at before
                return enlarged(known.image, scene.height, scene.width), known.error

    def _draft(self, view: View, materials: tuple[Material, ...], size: int) -> Drafted:
        start = time.perf_counter()
        if view.draft is None or view.draft[0] != size:
            tree = self._trees.of(view.scene.environment)
            grid = self.embedding.grid_
            view.draft = size, Draft(view.scene, grid, size, tree=tree, seed=self.settings.seed)
        tables = {m: m.values(self.embedding) for m in materials}
        image, error = view.draft[1].render(
            [tables[m] for m in materials], [m.mirror for m in materials]
        )
        view.times["draft"] = time.perf_counter() - start
        return Drafted(size, materials, image, error)

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
                if one.tier != "exact" and one.frame.error > self._renderer().allowed(view, i)
            ]

    def before(self) -> Float32:
        """The frame (H, W, 3) as it would be without this session's edits; nothing is changed."""
        # a ground that was assigned had another material before
        self._edited.update(*(edit.before for edit in self._done))
        with self._prepared() as (view, transport):
            old = dict(self._materials)
            for edit in reversed(self._done):
                old.update(edit.before)
            materials = [old[part] for part in view.scene.parts]
            return self._renderer().frame(view, transport, materials, exact=False)

    @property
    def frame_error(self) -> float | None:
        """Mean relative L1 of the last frame by its own measurement; None before the first."""
        with self._lock:
            view = self._view
            known = view.prepared
            return measured(view, known.transport) if known is not None and view.shown else None

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
                image, error = self._frame(view, transport), measured(view, transport)
            yield image, error, 1.0
        finally:
            if not self.ready:
                self.cancel()

    @contextlib.contextmanager
    def _prepared(self) -> Iterator[tuple[View, Transport]]:
        """The lock, held once the present view is ready: never while it is waited for."""
        while True:
            self.prepare()
            with self._lock:
                view = self._view
                transport = self._serving(view)
                if transport is not None:
                    yield view, transport
                    return

    def _renderer(self) -> Renderer:
        return Renderer(self.embedding, self.settings)

    def _frame(self, view: View, transport: Transport, exact: bool = True) -> Float32:
        materials = [self._materials[part] for part in view.scene.parts]
        return self._renderer().frame(view, transport, materials, exact)

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
        measured (`traitbrdf.session.budget.Promise`).

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
            return {
                "quality": self.quality,
                "error_asked": EXACT_ABOVE if self.error is None else self.error,
                **view_report(view, transport, materials, self.embedding, self.device),
                "parts": {
                    part: {
                        **part_report(material, view.shown[i], self.traits),
                        "max_albedo": self.brdf(part).max_albedo(),
                        **self.plausibility(part),
                        "move": str(self._reached[part]) if part in self._reached else None,
                    }
                    for i, (part, material) in enumerate(
                        zip(view.scene.parts, materials, strict=True)
                    )
                },
                "history": self.history,
            }

    def angles(self, part: str | None = None) -> AnglesSeen:
        """Which angles of the BRDF of a part (None: of the shape) this scene shows at all.

        What light and view leave out, no edit changes: `traitbrdf.pictures.angle_map` draws it.
        """
        index = None if part is None else self.part(part)
        return angles_seen(self.scene, self.embedding.grid_, index)

    # -- files ----------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write the design (present view and light, materials, history) to one file; atomic.

        The file holds arrays and JSON only. A loaded design renders the same frame: bit by bit
        where the parts are shown by the basis as prepared or exactly, within the error asked for
        where the basis was trained meanwhile. What was undone is not kept.
        """
        with self._lock:
            scene, materials = self.scene, dict(self._materials)
            said = [*self._replayed, *(edit.said for edit in self._done)]
        write_design(path, scene, materials, said, self.settings, self.traits, self.embedding)

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> EditSession:
        """Read a design written by `save`; `settings` are passed to `EditSession`.

        Designs of format 1, before there were shadows, load as they were: without shadows and
        ground, one ray a pixel.

        Raises
        ------
        FileNotFoundError, traitbrdf.formats.files.FormatError
            Also if the design was made with another embedding than the one at hand: its
            coordinates would mean other materials.
        """
        stored = Stored.read(path)
        given = dict(stored.settings)
        if stored.traits is not None:
            given["traits"] = stored.traits
        session = cls(stored.scene, **{**given, **settings})
        session._materials.update(stored.materials(session.embedding))
        session._replayed = stored.said
        return session
