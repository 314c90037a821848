"""A scene shown live: prepared once, then drawn with the materials that its parts have.

*Views.* Camera, light and size do not belong to the materials: `Viewer.look` changes them. All that
is prepared for one view lies in one object (`View`). The next look replaces it as a whole, so that
no frame of an old view can appear later.

*Threads.* A preparation may run in the background (`prepare(wait=False)`). It works on what it was
given, publishes its result in one step under the viewer's lock, and, if it is cancelled, stops at
its next report of progress. Heavy work takes turns (`TURNS`); drafts and exact frames go first,
because somebody waits for them.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any, Literal, overload

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.design.effects import Palette
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.formats.files import unknown_name
from traitbrdf.host import steady_in_threads
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap, Light
from traitbrdf.scene.scene import Scene
from traitbrdf.session.cache import Cache
from traitbrdf.session.frames import Drafted, MadeOf, Shown, View, enlarged, measured
from traitbrdf.session.local import blends
from traitbrdf.session.preparation import (
    DRAFT_SIZE,
    NODES,
    TURNS,
    LightTrees,
    Preparation,
    Prepared,
    StoppedError,
    prepare_view,
    universal_basis,
)
from traitbrdf.session.rendering import Renderer
from traitbrdf.session.settings import Settings
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.library import Library
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace
from traitbrdf.transport.angles import AnglesSeen, angles_seen
from traitbrdf.transport.blends import Blend
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.glances import Glances
from traitbrdf.transport.nodes import NodeTransport
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
_FEW = 4  # materials of a locally painted part in small frames
_DECODED = 64  # tables that drafts keep
_LEARNT = 4  # knots of local paint that are computed while others wait
_TICK = 0.2  # seconds between two images of `frames` while a scene is prepared


@steady_in_threads
class Viewer:
    """Prepares and draws a scene; `EditSession` adds materials that change.

    Subclasses provide `materials`, and the `library` and `traits` that they are made with. They add
    to `_edited` the parts that the preparation has to serve any material of.

    Parameters
    ----------
    scene : Scene
    settings : Settings
    progress : callable or None
        Called with (stage, fraction) while the scene is prepared; it may raise to cancel.
    transport : Transport or None
        A prepared transport of this very scene; None prepares the scene when needed.

    Attributes
    ----------
    settings, progress
        As given.

    Raises
    ------
    TypeError, ValueError
        If `scene` is no Scene, or `transport` belongs to another one.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        progress: Progress | None = None,
        transport: Transport | None = None,
    ) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a Scene, got {scene!r}")
        self.settings = settings
        self.progress = progress
        self._cache = Cache.usual() if settings.cache else None
        self._trees = LightTrees()
        self._lock = threading.RLock()
        self._view = View(scene)
        self._glances: Glances | None = None
        self._decoded: dict[Material, Float32] = {}  # tables of the latest drafts
        self._cancels = 0  # calls of `cancel`
        self._edited: set[str] = set()  # parts that a preparation has to serve all edits of
        if transport is not None:
            if transport.scene is not scene:
                raise ValueError("transport: expected the transport of this scene, got another's")
            self._view.prepared = Prepared(transport, False, {}, transport)

    @property
    def materials(self) -> Mapping[str, Material]:
        """The material of every part."""
        raise NotImplementedError

    @property
    def varying(self) -> Mapping[str, Varying]:
        """How the material of parts that are painted locally varies, by part."""
        return {}

    @property
    def library(self) -> Library:
        """The library whose members name materials."""
        raise NotImplementedError

    @property
    def traits(self) -> TraitSpace:
        """The traits that move materials."""
        raise NotImplementedError

    @property
    def embedding(self) -> BRDFEmbedding:
        """The library's embedding."""
        return self.library.embedding

    @property
    def view(self) -> View:
        """All that is prepared and shown of the present scene; the next `look` replaces it."""
        return self._view

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
        """The scene in view; `look` replaces it."""
        return self._view.scene

    def part(self, name: str) -> int:
        """Return the index of a part.

        Parameters
        ----------
        name : str

        Raises
        ------
        ValueError
            On an unknown name; the message names similar ones.
        """
        if name not in self.scene.parts:
            raise ValueError(unknown_name("part", name, self.scene.parts))
        return self.scene.parts.index(name)

    # -- view and light -------------------------------------------------------------------------

    def look(
        self,
        camera: Camera | None = None,
        environment: EnvironmentMap | None = None,
        lights: Sequence[Light] | None = None,
        size: int | tuple[int, int] | None = None,
        rotation: float | None = None,
    ) -> None:
        """Change the view or the light; what is None stays, and so do materials and undo.

        A running preparation is cancelled; the next `render` prepares the new view.

        Parameters
        ----------
        camera : Camera
        environment : EnvironmentMap
        lights : sequence of PointLight and DirectionalLight
            All of them.
        size : int or (height, width)
            In pixels.
        rotation : float
            Angle in radians by which the map is turned about +y (`EnvironmentMap.rotation`).

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
        """Whether the present view is prepared, so that `render` takes milliseconds."""
        return self._serving(self._view) is not None

    def _serving(self, view: View) -> Transport | None:
        """Return the view's transport if it is prepared for the present materials, else None."""
        known = view.prepared
        if known is None:
            return None
        for index, material in known.fixed.items():
            part = view.scene.parts[index]
            if part in self._edited or self.materials[part] != material:
                return None
        return known.transport

    @overload
    def prepare(self, wait: Literal[True] = True) -> Transport: ...

    @overload
    def prepare(self, wait: bool) -> Transport | None: ...

    def prepare(self, wait: bool = True) -> Transport | None:
        """Compress the scene's light transport, unless that is done already.

        A ground that nobody edits is prepared for its present material only; its first edit makes
        the next `prepare` do the rest.

        Parameters
        ----------
        wait : bool
            False starts the preparation in a background thread, unless one runs, and returns.

        Returns
        -------
        Transport or None
            None while it is not ready (only if `wait` is False).

        Raises
        ------
        concurrent.futures.CancelledError
            If it was cancelled by another thread while this one waited.
        RuntimeError
            If the `progress` callback waits for the preparation that called it.
        Exception
            The error of a background preparation, once; the next call tries again.
        """
        while True:
            with self._lock:
                view, job = self._view, self._view.job
                transport = self._serving(view)
                if transport is not None:
                    return transport
                fresh = job is None
                if job is None:
                    job = view.job = self._new_job(view, shown=not wait)
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

    def _new_job(self, view: View, shown: bool) -> Preparation:
        # neither function holds the session, so that an unused one can be collected
        lock = self._lock

        def publish(job: Preparation, prepared: Prepared) -> None:
            with lock:
                known = view.prepared
                if known is None or len(known.fixed) > len(prepared.fixed):
                    view.prepared, view.canvas, view.nodes = prepared, None, None
                    view.times["prepare"] = job.seconds
                if view.job is job:
                    view.job = None

        scene, fixed = view.scene, {}
        if scene.ground and scene.parts[-1] not in self._edited and view.prepared is None:
            fixed[len(scene.parts) - 1] = self.materials[scene.parts[-1]]
        known = None if view.prepared is None else view.prepared.whole
        palette, settings = Palette(self.library, self.traits), self.settings
        library, cache, trees = self.library, self._cache, self._trees
        owner = weakref.ref(self)

        def begin(report: Progress) -> None:
            """Prepare images at nodes, which show edits until the whole is prepared."""
            # who waits for the frame does not look at drafts
            if cache is None or known is not None or not shown:
                return
            basis = universal_basis(library, settings.seed, cache, report)
            nodes = view.nodes
            for count in NODES:
                if nodes is not None and nodes.count >= count:
                    continue  # of a preparation of this view that was cancelled
                session = owner()
                if session is None:
                    return
                # nodes are placed for what the parts are made of by now
                present = [session.materials[part] for part in scene.parts]
                del session
                decoded = {m: m.values(library.embedding) for m in present}
                tables = [decoded[m] for m in present]
                if nodes is None:
                    nodes = NodeTransport(
                        scene, basis, tables, count, tree=trees.of(scene.environment),
                        seed=settings.seed, progress=report,
                    )  # fmt: skip
                else:
                    nodes = nodes.refined(count, tables, progress=report)
                with lock:
                    view.nodes = nodes
            if nodes is not None:
                nodes.forget()

        work = functools.partial(
            prepare_view, scene, settings, palette, cache, fixed, known, begin
        )  # fmt: skip
        return Preparation(work, publish, self.progress, owner)

    def cancel(self) -> None:
        """Cancel a running preparation or `improve`, which ends soon; the session goes on."""
        with self._lock:
            self._cancels += 1
            TURNS.wake()
            job = self._view.job
            if job is not None and not job.done.is_set():
                self._view.job = None
                job.stop()

    def draft(self, size: int | None = None) -> tuple[Float32, float]:
        """Render a first image at once, before the view is prepared.

        It is rendered at a small size and enlarged; the first one of a view takes longer than
        later ones. As soon as a running preparation has images at some nodes, drafts have the
        size of the scene and take milliseconds.

        Parameters
        ----------
        size : int
            Pixels along the longer side at which it is rendered; None is the best at hand, or 128.

        Returns
        -------
        image : (H, W, 3) float32 linear radiance, backdrop included
        error : float
            Mean relative L1 over the covered pixels, measured at some of them.

        Raises
        ------
        ValueError
            If `size` is no positive integer.
        """
        wanted = DRAFT_SIZE if size is None else size
        _check_pixels(wanted)
        while True:
            with self._lock:
                view = self._view
                scene = view.scene
                made_of = self._made_of(scene)
                nodes = view.nodes if size is None else None
            known, kind = view.drafted, wanted if nodes is None else -len(nodes.nodes)
            if known is None or known.size != kind or known.made_of != made_of:
                if nodes is None:
                    with TURNS.urgent():
                        known = self._draft(view, made_of, wanted)
                else:
                    known = self._at_nodes(view, nodes, made_of)
                view.drafted = known
            if view is self._view:  # else it is a picture of what was looked at before
                return enlarged(known.image, scene.height, scene.width), known.error

    def glance(self, size: int = 256) -> tuple[Float32, float]:
        """Show the view at once, small and enlarged: frames while camera or light is moved.

        After each `look`, a frame with the present materials takes a tenth of a second or less.
        Frames that follow one another do not flicker.

        Parameters
        ----------
        size : int
            Pixels along the longer side at which it is rendered.

        Returns
        -------
        image : (H, W, 3) float32 linear radiance, backdrop included
        error : float
            Mean relative L1 over the covered pixels without mirrors, measured at some of them.

        Raises
        ------
        ValueError
            If `size` is no positive integer.
        """
        _check_pixels(size)
        while True:
            with self._lock:
                view = self._view
                materials, varying = self._made_of(view.scene)
            start = time.perf_counter()
            with TURNS.urgent():
                if self._glances is None or self._glances.size != size:
                    self._glances = Glances(self.embedding.grid_, size, self.settings.seed)
                tree = self._trees.of(view.scene.environment)
                tables, mirrors = self._tables(materials)

                def painted(small: Scene) -> Mapping[int, Blend]:
                    weights = SurfaceWeights(small)
                    return blends(small, varying, weights, self._table, _FEW)  # noqa: B023

                some = painted if varying else None
                frame = self._glances.frame(view.scene, tables, mirrors, tree, some)
            view.times["glance"] = time.perf_counter() - start
            if view is self._view:  # else it is a picture of what was looked at before
                image = enlarged(frame.image, view.scene.height, view.scene.width)
                return image, frame.error

    def _made_of(self, scene: Scene) -> MadeOf:
        """Return what the parts of a scene are made of."""
        return tuple(self.materials[part] for part in scene.parts), self.varying

    def _tables(self, materials: Sequence[Material]) -> tuple[list[Float32], list[Float64]]:
        """Return each material's table (cells, 3), decoded once, and weight (3,) of a mirror."""
        return [self._table(m) for m in materials], [m.mirror for m in materials]

    def _table(self, material: Material) -> Float32:
        """Return a material's table (cells, 3), of which the latest are kept."""
        table = self._decoded.pop(material, None)
        self._decoded[material] = material.values(self.embedding) if table is None else table
        while len(self._decoded) > _DECODED:
            del self._decoded[next(iter(self._decoded))]
        return self._decoded[material]

    def _at_nodes(self, view: View, nodes: NodeTransport, made_of: MadeOf) -> Drafted:
        start = time.perf_counter()
        materials, varying = made_of
        tables, mirrors = self._tables(materials)
        some = blends(view.scene, varying, view.surface(), self._table)
        frame = nodes.frame(tables, mirrors, some)
        view.times["draft"] = time.perf_counter() - start
        return Drafted(-len(nodes.nodes), made_of, *frame)

    def _draft(self, view: View, made_of: MadeOf, size: int) -> Drafted:
        start = time.perf_counter()
        if view.draft is None or view.draft[0] != size:
            tree = self._trees.of(view.scene.environment)
            grid = self.embedding.grid_
            view.draft = size, Draft(view.scene, grid, size, tree=tree, seed=self.settings.seed)
        draft, (materials, varying) = view.draft[1], made_of
        weights = SurfaceWeights(draft.scene)
        some = blends(draft.scene, varying, weights, self._table, _FEW)
        image, error = draft.render(*self._tables(materials), some)
        view.times["draft"] = time.perf_counter() - start
        return Drafted(size, made_of, image, error)

    def render(self, wait: bool = True, exact: bool = True) -> Float32:
        """Return the frame: linear radiance, backdrop included, never negative.

        Parts whose material is that of a recent frame are not computed again, and only the pixels
        of changed parts are drawn.

        Parameters
        ----------
        wait : bool
            False returns the draft while the view is not prepared, and prepares it in the
            background.
        exact : bool
            False shows every part by the basis, within milliseconds, also where its measured error
            is larger than asked for: `doubtful` names those parts, and `frame_error` is the error.

        Returns
        -------
        (H, W, 3) float32
            The array is the caller's.

        Raises
        ------
        Exception
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
        """Parts of the last frame whose measured error is larger than the basis is trusted with."""
        with self._lock:
            view = self._view
            return [
                view.scene.parts[i]
                for i, one in enumerate(view.shown)
                if one.frame.error > self.renderer.allowed(view, i)
                and (one.tier != "exact" if one.worst is None else view.untried(i, one.worst))
            ]

    @property
    def unfinished(self) -> bool:
        """Whether `improve` has something to do: finish local paint, or render `doubtful` parts."""
        with self._lock:
            return self._behind() is not None or bool(self.doubtful)

    def _behind(self) -> tuple[str, bool] | None:
        """Return a part whose local paint is not finished, and whether knots are missing."""
        local, parts = self._view.local, self.scene.parts
        if local is None or self.settings.fps is not None:
            return None
        varying = self.varying
        for name in varying:
            if local.rough(parts.index(name)):
                return name, True
        for name, one in varying.items():
            if local.uncorrected(parts.index(name), one):
                return name, False
        return None

    def improve(self) -> bool:
        """Finish what is painted locally, or render one of the `doubtful` parts without the basis.

        This takes seconds, in the calling thread, while others edit and draw. Later frames show
        what was found, and similar materials by the basis, which learns from it.

        Returns
        -------
        bool
            Whether there was anything to improve; the next call may find more. False if it was
            cancelled.
        """
        with self._lock:
            view, transport = self._view, self._serving(self._view)
            if transport is None:
                return False
            self._frame(view, transport, exact=False)  # what is doubtful among present materials
            renderer, owner, cancels = self.renderer, object(), self._cancels
            behind = self._behind()
            if behind is not None:
                name = behind[0]
            elif self.doubtful:
                name = self.doubtful[0]
            else:
                return False
            index = view.scene.parts.index(name)
            worst = view.shown[index].worst
            material = self.materials[name] if worst is None else worst
            made_of = self.materials[name], self.varying.get(name)

        def outdated() -> bool:
            if self._cancels != cancels:
                return True
            present = self.materials[name], self.varying.get(name)
            return self._view is not view or present != made_of

        def told(stage: str, fraction: float) -> None:
            TURNS.give(owner)  # drafts and frames that somebody waits for go first
            TURNS.take(owner, False, outdated)

        start = time.perf_counter()
        try:
            TURNS.take(owner, False, outdated)
            if behind is not None:
                finish = self._finish if behind[1] else self._correct
                finish(view, transport, name, told)
                return True
            found = renderer.exact(view, transport, index, material, told)
        except StoppedError:
            return self._cancels == cancels
        finally:
            TURNS.give(owner)
        with self._lock:
            if self._serving(view) is transport:
                renderer.take(view, transport, index, found)
                seconds = time.perf_counter() - start
                if worst is None:
                    view.keep(index, material, Shown(found.frame, "exact", seconds))
                else:
                    view.tried.add((index, worst))
        return True

    def _correct(self, view: View, transport: Transport, name: str, told: Progress) -> None:
        """Correct what the basis shows of a locally painted part."""
        index = view.scene.parts.index(name)
        with self._lock:
            varying, local = self.varying.get(name), view.local
            if varying is None or local is None or not local.current:
                return
            wanted = local.uncorrected(index, varying)
            materials = local.halves(varying, wanted)
        if wanted:
            found = local.exact(index, materials, wanted, told)
            with self._lock:
                if view.local is local and local.current and self.varying.get(name) is varying:
                    local.correct(index, varying, found)

    def _finish(self, view: View, transport: Transport, name: str, told: Progress) -> None:
        """Compute what the finished frame of a locally painted part needs, a little at a time."""
        index = view.scene.parts.index(name)
        knots: list[tuple[int, ...]] | None = None
        while knots is None or knots:
            told("painting", 0.0)
            with self._lock:
                varying, local = self.varying.get(name), view.local
                if varying is None or local is None or self._serving(view) is not transport:
                    return
                if knots is None:
                    knots = local.lacking(index, varying)
                some, knots = knots[:_LEARNT], knots[_LEARNT:]
                local.learn(index, varying, some)
                if not knots:
                    local.finish(index, varying)

    @property
    def frame_error(self) -> float | None:
        """Measured mean relative L1 of the last frame; None before the first."""
        with self._lock:
            view = self._view
            known = view.prepared
            return measured(view, known.transport) if known is not None and view.shown else None

    def frames(self, exact: bool = True) -> Iterator[tuple[Float32, float, float]]:
        """Yield images that get better: drafts, then the finished frame.

        Closing the generator cancels the preparation, and cancelling the preparation ends the
        generator.

        Parameters
        ----------
        exact : bool
            Of the finished frame, as for `render`.

        Yields
        ------
        image : (H, W, 3) float32
            The draft, whenever the preparation has advanced or a material has changed; at last the
            frame.
        error : float
            Measured mean relative L1.
        fraction : float
            Share of the preparation that is done; 1 with the frame.

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
                    if self._view is not view:  # the job of the old view is void
                        view, job = self._view, None
                    if job is not None and job.stopped:
                        return
                    self.prepare(wait=False)
                    job = view.job or job
                if job is not None:
                    job.done.wait(_TICK)
            with self._prepared() as (view, transport):
                image, error = self._frame(view, transport, exact), measured(view, transport)
            yield image, error, 1.0
        finally:
            if not self.ready:
                self.cancel()

    @contextlib.contextmanager
    def _prepared(self) -> Iterator[tuple[View, Transport]]:
        """Hold the lock once the present view is prepared, but never while waiting for that."""
        while True:
            self.prepare()
            with self._lock:
                view = self._view
                transport = self._serving(view)
                if transport is not None:
                    yield view, transport
                    return

    @property
    def renderer(self) -> Renderer:
        """Makes the frames of a view, as exact as was asked for."""
        return Renderer(self.embedding, self.settings)

    def _frame(self, view: View, transport: Transport, exact: bool = True) -> Float32:
        materials = [self.materials[part] for part in view.scene.parts]
        return self.renderer.frame(view, transport, materials, exact, self.varying)

    # -- gradients ------------------------------------------------------------------------------

    def radiance(self, part: str, z: torch.Tensor) -> torch.Tensor:
        """Compute a part's linear radiance as a differentiable function of coordinates.

        Parameters
        ----------
        part : str
            Name of the part.
        z : (k,) tensor, float32 or float64
            Coordinates.

        Returns
        -------
        (P, 3) float32 tensor on the session's device
            What the part adds to its pixels (`gradient` returns which) if its coordinates are `z`,
            by the basis and not clamped at 0. The part of an assigned table that lies beside the
            manifold, and a mirror, stay.

        Raises
        ------
        ValueError
            On an unknown part.
        """
        index, material = self.part(part), self.materials[part]
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
        """Differentiate the linear frame by a part's coordinates, in closed form.

        Parameters
        ----------
        part : str
            Name of the part.

        Returns
        -------
        pixels : (P,) int64
            Flat indices (row * width + column) of the pixels that show the part.
        slopes : (P, 3, k) float32
            d radiance / d z of each pixel and colour, of `radiance` at the present coordinates.
        """
        index, material = self.part(part), self.materials[part]
        self._edited.add(part)
        with self._prepared() as (view, transport):
            slopes = self.embedding.jacobian(material.z, material.offset, transport.cells)
            columns = torch.from_numpy(slopes).to(self.device).permute(2, 0, 1)
            # radiance is linear in the table: all coordinates in one product
            moved = torch.vmap(lambda table: transport.radiance(index, table))(columns)
            pixels = view.scene.pixels[view.scene.part_slice(index)].copy()
        return pixels, moved.permute(1, 2, 0).contiguous().cpu().numpy()

    def angles(self, part: str | None = None) -> AnglesSeen:
        """Find which angles of a BRDF this scene shows at all.

        Edits at other angles change no pixel. `traitbrdf.pictures.angle_map` draws the result.

        Parameters
        ----------
        part : str or None
            Name of a part; None is the whole shape.
        """
        index = None if part is None else self.part(part)
        return angles_seen(self.scene, self.embedding.grid_, index)


def _check_pixels(size: object) -> None:
    """Raise ValueError unless a size is a positive number of pixels."""
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise ValueError(f"size: expected a positive number of pixels, got {size!r}")
