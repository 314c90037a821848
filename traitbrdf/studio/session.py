"""The protocol of the live canvas and the object that speaks it, independent of the transport.

Every message is a JSON header and at most one binary buffer. The page sends one request and waits
for its one reply before it sends the next, which then holds all that the pointer did meanwhile. So
no queue can grow, and both sides lag by one frame at most.

Up (page to session). All keys but ``kind`` and ``view`` may be missing.

``{"kind": "hello", "view", "origin"}``
    Asks for everything: names, sizes, a whole frame. ``origin`` is the page's own, if it prefers a
    socket: transports that can offer one add its address to the reply, as ``socket``.
``{"kind": "input", "view", "seq", ...}`` with samples (n, 4) float32: x, y, pressure, phase
    ``seq`` is any number; the reply repeats it. Samples are in pixels of the image; pressure is 0
    to 1; in phase 0 the pen goes down, in 1 it moves, in 2 it is lifted. Further keys, in the order
    in which they are obeyed:

    - ``part``: choose a part by name; ``pick`` [x, y]: choose the part at a pixel
    - ``brush`` {trait, amount, radius, stay}: brush of the samples; ``stay`` paints only the part
      on which a stroke begins. With ``where`` "local" the surface is painted, softly: by
      ``hardness`` and ``flow``, with ``material`` (a library name) or ``tint`` (a colour #rrggbb,
      of the body) in the place of the trait if they are there; ``onto`` is the index of a layer
      that gets the stroke, or from which ``erase`` takes paint away
    - ``layer`` {index, do} with "delete", "duplicate", "up", "down", "clear" or "invert", or
      {index, set {opacity, visible, name}, done}
    - ``slide`` {part, amounts {trait: change since the slider was taken}, done}
    - ``assign`` {part, material}, or {at [x, y], material} for the part at a pixel
    - ``orbit`` [degrees right, degrees up], ``zoom`` factor, ``turn`` degrees of the map;
      ``dragging`` says that more of these follow at once: they get glances, and preparation waits
      for the end of the drag
    - ``shelf`` {query}: the library materials that a query describes (`find_materials`); the
      ``shelf`` message below is the answer
    - ``do``: "undo", "redo"
    - ``save``, ``open``: names of design files in the session's folder; ``export``: the name of a
      file there for other programs, of the design (.glb, .mtlx, .py), the frame (.png) or the
      chosen part's material (.binary, .bsdf, .npz). It is written behind; ``told`` says when
    - ``before``: show the frame without any layer
    - ``exact``: render parts that the basis shows too inexactly without it, which takes seconds
    - ``rest``: the pointer rests: send the whole frame without loss
    - ``pad``: pad the reply's buffer with zeros to at least 66,000 bytes, since sockets of notebook
      servers delay the end of smaller ones by 40 ms

Down (session to page)

``{"kind": "frame", "view", "seq", "format", "x", "y", "w", "h", "width", "height", "ms", "state",
"bytes", ...}`` with the pixels that changed: the first ``bytes`` of the buffer
    ``format`` is "jpeg", "png", "rgb" (3 bytes a pixel) or "none" (nothing changed). ``ms`` are
    milliseconds spent on "edit", "render" and "encode". ``state`` has the chosen part and what can
    be done: see `Session._state`. The reply to a hello also has ``parts``, ``traits``, ``library``
    and ``groups`` [title, traits] of the traits, the few that matter first; so has the next reply
    to a view when they change, because a design of another shape was opened.
``{"kind": "error", "view", "seq", "message"}``
    The request was not obeyed, or only in part. The session goes on.
``{"kind": "shelf", "view", "query", "names", "total", "side"}``
    The first materials of ``total`` that a query describes, and in the buffer a JPEG of their
    spheres side by side. It comes once more when spheres that were not drawn yet are.
``{"kind": "told", "view", "message", "done"}``
    What became of an export; ``done`` is false if it failed.
``{"kind": "changed", "by", "ready", "fraction"}``
    Pushed to subscribers, at most ten times a second: a view (``by``; "" is several) or the
    preparation changed the picture. Other views ask for it by an empty input when they want it.
"""

from __future__ import annotations

import contextlib
import io
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from traitbrdf.design.colours import Colour
from traitbrdf.design.effects import Assign, Effect, Move
from traitbrdf.design.strokes import Stroke
from traitbrdf.export.files import SUFFIXES
from traitbrdf.formats.display import Display, exposure_of
from traitbrdf.formats.files import atomic_path, unknown_name
from traitbrdf.scene.camera import Camera
from traitbrdf.session.editing import EditSession
from traitbrdf.space.search import find_materials
from traitbrdf.space.traits import default_traits
from traitbrdf.studio.lists import grouped, layer_told, shortened
from traitbrdf.studio.shelf import SIDE, Shelf

Header = dict[str, Any]
Reply = tuple[Header, list[bytes]]
Push = Callable[[Header, list[bytes]], None]
T = TypeVar("T")

LARGEST = 1 << 20
"""Size of the largest message that is accepted, in bytes."""
_RAW = 200_000
"""A rectangle of at most this many bytes is sent as it is, since encoding takes longer."""
_SHELF = 24
"""Materials of one answer to a query."""
_AT_ONCE = 6
"""Spheres that are drawn before a view is told."""
_VIEWS = 32
"""Number of views whose last frame is remembered."""
_SPACING = 0.03
"""A sample is left out if it is nearer to the last one than this share of the brush's radius, or
than half a pixel."""
_POINTS = 4096
"""Greatest number of points of one stroke; later ones are left out."""
_NEWS = 0.1
"""Seconds for which changes are collected before views are told."""
_PADDED = 66_000
_MATERIALS = (".binary", ".bsdf", ".npz")
_SETTINGS = {"opacity", "visible", "name"}
"""Settings of layers that a page may change."""
_CHANGES = {
    "part",
    "pick",
    "brush",
    "slide",
    "layer",
    "assign",
    "orbit",
    "zoom",
    "turn",
    "do",
    "open",
}
"""Keys of requests that may change what other views show."""


@dataclass(frozen=True)
class _Local:
    """A brush on the surface."""

    effect: Effect
    radius: float
    hardness: float
    flow: float
    onto: int | None
    erase: bool

    @classmethod
    def of(cls, brush: Mapping[str, Any], amount: float, radius: float) -> _Local:
        """Return the brush that a page asks for."""
        effect: Effect
        if brush.get("material"):
            effect = Assign(str(brush["material"]))
        elif brush.get("tint"):
            effect = Colour(str(brush["tint"]))
        else:
            effect = Move({str(brush.get("trait")): amount})
        values = [brush.get("hardness", 0.5), brush.get("flow", 1.0)]
        hardness, flow = _numbers(values, 2)
        onto = brush.get("onto")
        if onto is not None and (isinstance(onto, bool) or not isinstance(onto, int)):
            raise TypeError(f"onto: expected the index of a layer, got {onto!r}")
        erase = brush.get("erase") is True
        if erase and onto is None:
            raise ValueError("erase: expected a layer to take paint away from: choose one")
        return cls(effect, radius, hardness, flow, onto, erase)


class Session:
    """One `EditSession` for any number of views; see the module for the protocol.

    Parameters
    ----------
    edit : EditSession
    folder : path or None
        Where designs are saved and opened; None is the working directory.
    quality : int
        Of JPEG frames, 1 to 95.

    Attributes
    ----------
    edit : EditSession
        The session in view; opening a design replaces it.
    folder, quality
        As given.
    subscribers : dict
        Callbacks that are told of changes.
    refiner : threading.Thread or None
        Prepares the view in the background.
    display : Display
        Tone curve of what is sent.
    """

    def __init__(
        self, edit: EditSession, folder: str | Path | None = None, quality: int = 90
    ) -> None:
        self.edit = edit
        self.folder = _here() if folder is None else Path(folder)
        self.quality = quality
        self._lock = threading.RLock()
        self.subscribers: dict[object, Push] = {}
        self._sent: dict[str, NDArray[np.float32]] = {}
        self._shelf = Shelf(edit.library)
        self._drawing = threading.Lock()
        self._exporting: threading.Thread | None = None
        self._wanted: dict[str, tuple[str, list[str], int]] = {}
        self._listed: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}
        self._stroke: Stroke | None = None
        self._strength = (0.0, 0.0, 0)  # pixels travelled, sum of pressures, samples
        self._local: _Local | None = None
        self._sliding = False
        self._hand: str | None = None  # the view whose stroke or slider is at work
        self._mine: object = None  # the design that it made, and replaces
        self._only: str | None = None  # the part that the stroke at work stays on
        self._dragging = False
        self._part = edit.scene.parts[0]
        self._light: object = None
        self.display = Display(1.0)
        self._telling: threading.Timer | None = None
        self._teller = ""  # the view that changed what will be told
        self.refiner: threading.Thread | None = None
        self._closed = False
        self._fraction = 0.0
        self._trouble = ""
        self._asked = False  # whether the refiner was asked for while it ran

    # -- transports -----------------------------------------------------------------------------

    def handle(self, header: object, buffers: Sequence[bytes | memoryview] = ()) -> list[Reply]:
        """Return the replies to one message; errors become replies and are never raised.

        Parameters
        ----------
        header : object
            The decoded JSON header.
        buffers : sequence of bytes, at most one
        """
        view, seq = "", None
        try:
            if not isinstance(header, Mapping):
                raise TypeError(f"message: expected an object, got {type(header).__name__}")
            view, seq = str(header.get("view", ""))[:64], header.get("seq")
            if isinstance(seq, bool) or not isinstance(seq, (int, float)) or not math.isfinite(seq):
                seq = None  # NaN would be no JSON
            size = sum(len(memoryview(b).cast("B")) for b in buffers)
            if size > LARGEST:
                raise ValueError(f"message: expected at most {LARGEST} bytes, got {size}")
            with self._lock, torch.no_grad():
                return self._obey(view, seq, header, buffers)
        except Exception as error:
            message = f"{error}" if isinstance(error, (ValueError, TypeError)) else f"{error!r}"
            return [({"kind": "error", "view": view, "seq": seq, "message": message[:500]}, [])]

    def subscribe(self, push: Push) -> Callable[[], None]:
        """Have `push` called with unasked changes, from any thread; return a function that ends it.

        Parameters
        ----------
        push : callable
            Takes a header and buffers.
        """
        key = object()
        with self._lock:
            self.subscribers[key] = push

        def end() -> None:
            with self._lock:
                self.subscribers.pop(key, None)

        return end

    def close(self) -> None:
        """End all background work."""
        with self._lock:
            self._closed = True
            self.subscribers.clear()
            if self._telling is not None:
                self._telling.cancel()
        self.edit.cancel()
        # they may end meanwhile, and say so by None
        for thread in (self.refiner, self._exporting):
            if thread is not None:
                thread.join(10.0)

    def still(self) -> bytes:
        """Return the present frame as PNG; a draft if the view is not prepared."""
        with self._lock, torch.no_grad():
            edit = self.edit
            image = edit.render(exact=False) if edit.ready else edit.draft()[0]
            self._expose(image)
            return _png(self.display(image))

    # -- requests -------------------------------------------------------------------------------

    def _obey(
        self, view: str, seq: float | None, header: Mapping[str, Any], buffers: Sequence[Any]
    ) -> list[Reply]:
        kind = header.get("kind")
        if kind not in ("hello", "input"):
            raise ValueError(f"kind: expected hello or input, got {kind!r}")
        start = time.perf_counter()
        trouble = self._act(view, header, buffers) if kind == "input" else ""
        edited = time.perf_counter()
        edit = self.edit
        ready = edit.ready
        dragging, rest = header.get("dragging") is True, header.get("rest") is True
        draft_error = None
        if not ready:
            # while the object is turned, speed matters more than detail
            image, draft_error = edit.glance() if dragging else edit.draft()
        elif header.get("before") is True:
            image = edit.before()
        else:
            # while the pointer moves, parts with a larger error than asked for are shown by the
            # basis, with their error beside them; a request may ask for the exact frame
            image = edit.render(exact=header.get("exact") is True)
        rendered = time.perf_counter()
        reply, pixels = self._encoded(view, image, kind == "hello" or rest, rest)
        done = time.perf_counter()
        reply |= {
            "kind": "frame",
            "view": view,
            "seq": seq,
            "state": self._state(view, draft_error),
        }
        reply["ms"] = {
            "edit": round(1e3 * (edited - start), 2),
            "render": round(1e3 * (rendered - edited), 2),
            "encode": round(1e3 * (done - rendered), 2),
        }
        listed = edit.scene.parts, edit.traits.names
        if kind == "hello" or self._listed.get(view, listed) != listed:
            reply["parts"] = list(edit.scene.parts)
            reply["traits"] = list(edit.traits.names)
            reply["groups"] = grouped(edit.traits.names)
            reply["library"] = list(edit.library.names)
            _keep(self._listed, view, listed)
        self._dragging = dragging
        # what is prepared, or made exact, is shown when it is there: nobody waits
        if not self._dragging and (not ready or (rest and edit.unfinished)):
            self._refine()
        if _CHANGES.intersection(header):
            self._tell(view)
        reply["bytes"] = len(pixels)
        if header.get("pad") is True:
            pixels += bytes(max(0, _PADDED - len(pixels)))
        replies: list[Reply] = [(reply, [pixels] if pixels else [])]
        if "shelf" in header and view in self._wanted:
            replies.append(self._shelf_of(view))
            if self._shelf.missing(self._wanted[view][1]):
                threading.Thread(target=self._draw_shelf, daemon=True).start()
        if trouble:
            replies.insert(
                0, ({"kind": "error", "view": view, "seq": None, "message": trouble}, [])
            )
        return replies

    def _act(self, view: str, header: Mapping[str, Any], buffers: Sequence[Any]) -> str:
        """Obey an input as far as possible; return what failed, in words."""
        failed = []
        for key, act in (
            ("part", self._choose),
            ("pick", self._pick),
            ("brush", lambda brush: self._paint(view, brush, buffers)),
            ("slide", lambda slide: self._slide(view, slide)),
            ("layer", lambda layer: self._layer(view, layer)),
            ("assign", self._assign),
            ("shelf", lambda shelf: self._browse(view, shelf)),
            ("orbit", lambda _: self._look(header)),
            ("zoom", lambda _: None if "orbit" in header else self._look(header)),
            ("turn", self._turn),
            ("do", self._do),
            ("save", self._save),
            ("open", self._open),
            ("export", lambda name: self._export(view, name)),
        ):
            if key in header:
                try:
                    act(header[key])
                except Exception as error:
                    failed.append(f"{key}: {error}")
                    if key in ("brush", "slide", "layer"):
                        self._give_up()
        return "; ".join(failed)[:500]

    def _choose(self, part: object) -> None:
        if not isinstance(part, str):
            raise TypeError(f"expected a name, got {part!r}")
        self.edit.part(part)
        self._part = part

    def _pick(self, place: object) -> None:
        found = self._under(_numbers(place, 2))
        if found >= 0:
            self._part = self.edit.scene.parts[found]

    def _under(self, place: Sequence[float]) -> int:
        """Return the index of the part at a place (x, y) of the image; -1 for none."""
        x, y = (math.floor(v) for v in place)
        scene = self.edit.scene
        inside = 0 <= x < scene.width and 0 <= y < scene.height
        return int(scene.part_image[y, x]) if inside else -1

    def _paint(self, view: str, brush: object, buffers: Sequence[Any]) -> None:
        if not isinstance(brush, Mapping):
            raise TypeError(f"expected an object, got {brush!r}")
        raw = bytes(buffers[0]) if buffers else b""
        if len(raw) % 16:
            raise ValueError(f"expected samples of 16 bytes each, got {len(raw)} bytes")
        samples = np.frombuffer(raw, "<f4").reshape(-1, 4).astype(np.float64)
        if not np.isfinite(samples).all():
            raise ValueError("expected samples of finite numbers")
        radius, amount = _numbers([brush.get("radius"), brush.get("amount")], 2)
        local = None if brush.get("where") != "local" else _Local.of(brush, amount, radius)
        # one message may hold the end of one stroke and the beginning of the next
        for run in np.split(samples, np.flatnonzero(samples[:, 3] == 0.0)):
            if not len(run):
                continue
            if run[0, 3] == 0.0:
                self._give_up()
                self._strength, self._hand = (0.0, 0.0, 0), view
                self._local = local
            elif self._hand != view or self._sliding:
                continue  # of a stroke that was given up
            if self._local is not None:
                self._go_on(run, self._local, brush.get("stay") is True)
            else:
                self._continue(run, brush.get("trait"), amount, radius, brush.get("stay") is True)
            if (run[:, 3] == 2.0).any():
                self._give_up()

    def _continue(
        self, run: NDArray[np.float64], trait: Any, amount: float, radius: float, stay: bool
    ) -> None:
        """Extend the stroke: all of it so far is one layer, which replaces the one before."""
        kept: list[tuple[float, float]] = []
        known = self._stroke
        travelled, pressed, count = self._strength
        last = None if known is None else known.points[-1]
        room = _POINTS - (0 if known is None else len(known.points))
        for x, y, pressure, _ in run:
            step = 0.0 if last is None else math.hypot(x - last[0], y - last[1])
            if last is None or step >= max(0.5, _SPACING * radius):
                if len(kept) >= room:
                    break
                kept.append((float(x), float(y)))
                travelled += step
                last = kept[-1]
            pressed += min(max(float(pressure), 0.0), 1.0)
            count += 1
        # a dab gives a third of the amount, two radii of the brush all of it
        share = min(1.0, (1.0 + travelled / radius) / 3.0) if radius > 0.0 else 1.0
        whole = amount * share * pressed / max(count, 1)
        if known is None:
            stroke = Stroke(kept, trait, whole, radius)
        else:
            stroke = known.extended(kept, whole)
            self._take_back()
        self._stroke, self._strength = stroke, (travelled, pressed, count)
        scene = self.edit.scene
        parts = scene.part_image[stroke.coverage(scene.height, scene.width) > 0.0]
        parts = parts[parts >= 0]
        if not len(parts):
            return
        if stay and self._only is None:  # the part it begins on, or under most of the brush
            begun = (found for found in map(self._under, stroke.points) if found >= 0)
            self._only = scene.parts[next(begun, int(np.bincount(parts).argmax()))]
        self.edit.paint(stroke, only=self._only)
        self._mine = self.edit.design
        self._part = self._only or self._part

    def _go_on(self, run: NDArray[np.float64], brush: _Local, stay: bool) -> None:
        """Extend a stroke on the surface."""
        known = self._stroke
        last = None if known is None else known.points[-1]
        room = _POINTS - (0 if known is None else len(known.points))
        kept: list[tuple[float, float]] = []
        pressed: list[float] = []
        for x, y, pressure, _ in run:
            step = math.inf if last is None else math.hypot(x - last[0], y - last[1])
            if step >= max(0.5, _SPACING * brush.radius) and len(kept) < room:
                last = (float(x), float(y))
                kept.append(last)
                pressed.append(min(max(float(pressure), 0.0), 1.0))
        if known is None:
            stroke = Stroke(
                kept, radius=brush.radius, hardness=brush.hardness, flow=brush.flow,
                pressure=pressed,
            )  # fmt: skip
        else:
            if not kept:
                return
            stroke = known.extended(kept, pressure=pressed)
            self._take_back()
        self._stroke = stroke
        edit = self.edit
        seen = edit.pick(*stroke.points[0])
        if stay and self._only is None and seen is not None:
            self._only = seen.part
        if brush.onto is not None:
            layer = edit.layers[brush.onto]
            (layer.erase if brush.erase else layer.paint)(stroke)
        else:
            try:
                edit.paint(stroke, brush.effect, only=self._only, where="local")
            except ValueError as error:
                if "lies beside" in str(error):  # it may come to the object yet
                    return
                raise
        self._mine = edit.design
        self._part = self._only or self._part

    def _layer(self, view: str, layer: object) -> None:
        """Change a layer of the stack."""
        if not isinstance(layer, Mapping) or not isinstance(layer.get("index"), int):
            raise TypeError(f"expected an object with an index, got {layer!r}")
        if self._sliding and self._hand == view:
            self._take_back()
        self._give_up()
        index, do = layer["index"], layer.get("do")
        if not 0 <= index < len(self.edit.layers):
            raise ValueError(f"expected a layer from 0 to {len(self.edit.layers) - 1}, got {index}")
        one = self.edit.layers[index]
        if do is not None:
            acts: dict[object, Callable[[], object]] = {
                "delete": one.delete, "duplicate": one.duplicate, "clear": one.clear,
                "invert": one.invert,
                "up": lambda: one.move_to(min(index + 1, len(self.edit.layers) - 1)),
                "down": lambda: one.move_to(max(index - 1, 0)),
            }  # fmt: skip
            if do not in acts:
                raise ValueError(f"expected one of {', '.join(map(str, acts))}, got {do!r}")
            acts[do]()
            return
        settings = layer.get("set")
        if not isinstance(settings, Mapping) or not settings.keys() <= _SETTINGS:
            raise ValueError(f"expected settings among {sorted(_SETTINGS)}, got {settings!r}")
        for name, value in settings.items():
            setattr(one, name, value)
        if layer.get("done") is False:
            self._mine, self._hand, self._sliding = self.edit.design, view, True

    def _take_back(self) -> None:
        """Undo the unfinished stroke or slider, unless another change came since."""
        if self._mine is not None and self.edit.design is self._mine:
            self.edit.undo()
        self._mine = None

    def _slide(self, view: str, slide: object) -> None:
        if not isinstance(slide, Mapping) or not isinstance(slide.get("amounts"), Mapping):
            raise TypeError(f"expected an object with amounts, got {slide!r}")
        part, amounts = str(slide.get("part")), slide["amounts"]
        values = dict(zip(amounts, _numbers(list(amounts.values()), len(amounts)), strict=True))
        if self._sliding and self._hand == view:
            self._take_back()
        self._give_up()
        self.edit.move(part, **values)
        if slide.get("done") is not True:
            self._mine, self._hand, self._sliding = self.edit.design, view, True

    def _assign(self, assign: object) -> None:
        if not isinstance(assign, Mapping):
            raise TypeError(f"expected an object, got {assign!r}")
        part = assign.get("part")
        if "at" in assign:
            found = self._under(_numbers(assign["at"], 2))
            if found < 0:
                raise ValueError("expected a place on the object, got one beside it")
            self._part = part = self.edit.scene.parts[found]
        self.edit.assign(str(part), str(assign.get("material")))

    def _browse(self, view: str, shelf: object) -> None:
        """Look for library materials; `_shelf_of` has the answer."""
        query = shelf.get("query") if isinstance(shelf, Mapping) else None
        if not isinstance(query, str) or len(query) > 200:
            raise ValueError(f"expected a query of up to 200 letters, got {query!r}")
        names = find_materials(query, self.edit.library, self.edit.traits)
        _keep(self._wanted, view, (query, names[:_SHELF], len(names)))

    def _shelf_of(self, view: str) -> Reply:
        query, names, total = self._wanted[view]
        told = {
            "kind": "shelf", "view": view, "query": query, "names": names, "total": total,
            "side": SIDE,
        }  # fmt: skip
        return told, [self._shelf.strip(names)] if names else []

    def _draw_shelf(self) -> None:
        """Draw the spheres that views wait for, a few at a time, and tell of them."""
        with self._drawing:
            while not self._closed:
                with self._lock:
                    waiting = [self._shelf.missing(names) for _, names, _ in self._wanted.values()]
                drawn = next((names[:_AT_ONCE] for names in waiting if names), [])
                if not drawn:
                    return
                self._shelf.draw(drawn)
                with self._lock:  # several views may wait for the same spheres
                    news = [
                        self._shelf_of(view)
                        for view, (_, names, _) in self._wanted.items()
                        if not set(drawn).isdisjoint(names)
                    ]
                for one in news:
                    self._push(*one)

    def _look(self, header: Mapping[str, Any]) -> None:
        camera = self.edit.scene.camera
        right, up = _numbers(header.get("orbit", (0.0, 0.0)), 2)
        (zoom,) = _numbers([header.get("zoom", 1.0)], 1)
        self._give_up()
        self.edit.look(
            Camera(
                (camera.azimuth + right + 180.0) % 360.0 - 180.0,
                min(max(camera.elevation + up, -89.0), 89.0),
                camera.fov,
                min(max(camera.zoom * zoom, 0.2), 10.0),
                camera.target,
            )
        )

    def _turn(self, degrees: object) -> None:
        (angle,) = _numbers([degrees], 1)
        self._give_up()
        self.edit.look(rotation=self.edit.scene.environment.rotation + math.radians(angle))

    def _give_up(self) -> None:
        """End the unfinished stroke or slider; what it did stays."""
        self._stroke, self._sliding, self._only = None, False, None
        self._hand, self._mine = None, None

    def _do(self, what: object) -> None:
        self._give_up()
        if what not in ("undo", "redo"):
            raise ValueError(f"expected undo or redo, got {what!r}")
        if what == "undo":
            self.edit.undo()
        else:
            self.edit.redo()

    def _file(self, name: object, suffixes: Sequence[str] = (".tbr",)) -> Path:
        """Return a file, of the first ending if it has none; a page can name no other folder."""
        if not isinstance(name, str) or not name or name.startswith("."):
            raise ValueError(f"expected the name of a file, got {name!r}")
        if any(c in name for c in "/\\:\0") or len(name) > 100:
            raise ValueError(f"expected a name in {self.folder}, without a path, got {name!r}")
        if self.folder is None or not self.folder.is_dir():
            raise ValueError("the folder of designs was deleted: start anew in another one")
        return self.folder / (name if name.endswith(tuple(suffixes)) else name + suffixes[0])

    def _save(self, name: object) -> None:
        self.edit.save(self._file(name))

    def _export(self, view: str, name: object) -> None:
        """Write a file for another program behind, and tell when it is there."""
        path = self._file(name, (*SUFFIXES, ".png", *_MATERIALS))
        if self._exporting is not None and self._exporting.is_alive():
            raise ValueError("expected one export at a time: another is being written")
        edit, part = self.edit, self._part

        def go_on(_stage: str, _fraction: float) -> None:
            if self._closed:
                raise CancelledError

        def write() -> None:
            message, done = path.name, True
            try:
                if path.suffix == ".png":
                    still = self.still()
                    with atomic_path(path) as temporary:
                        temporary.write_bytes(still)
                elif path.suffix in _MATERIALS:
                    edit.brdf(part).write(path)
                else:
                    message = str(edit.export(path, progress=go_on))
            except CancelledError:
                return
            except Exception as error:
                message, done = f"export: {error}"[:500], False
            self._push({"kind": "told", "view": view, "message": message, "done": done}, [])

        self._exporting = threading.Thread(target=write, name="traitbrdf-export", daemon=True)
        self._exporting.start()

    def _open(self, name: object) -> None:
        path = self._file(name)
        if not path.is_file():
            known = sorted(p.name for p in path.parent.glob("*.tbr"))
            raise ValueError(unknown_name("design", path.name, known))
        old = self.edit
        # the design has its own promise, and traits of one's own
        self.edit = EditSession.load(path, library=old.library, device=old.device)
        if self.edit.traits is default_traits():
            self.edit.traits = old.traits
        old.cancel()
        self._give_up()
        self._light = None
        if self._part not in self.edit.scene.parts:
            self._part = self.edit.scene.parts[0]

    # -- replies --------------------------------------------------------------------------------

    def _state(self, view: str, draft_error: float | None) -> Header:
        """Return the state that controls show: chosen part, scores, errors, undo and redo."""
        edit = self.edit
        ready = draft_error is None
        told: Header = {}
        if self._hand != view:  # who drags is told at the end
            known = edit.history
            told = {
                "edits": len(edit.layers),
                "history": [shortened(line) for line in known[-6:]],
                "layers": [layer_told(layer.layer) for layer in edit.layers],
            }
        return {
            "part": self._part,
            "material": edit.material(self._part).name or "",
            "scores": {name: round(s, 4) for name, s in edit.scores(self._part).items()},
            "plausibility": {k: round(v, 4) for k, v in edit.plausibility(self._part).items()},
            "undo": edit.undoable,
            "redo": edit.redoable,
            "ready": ready,
            "fraction": 1.0 if ready else round(self._fraction, 3),
            "error": edit.frame_error if ready else draft_error,
            "doubtful": edit.doubtful if ready else [],
            "trouble": self._trouble,
            **told,
        }

    def _expose(self, image: NDArray[np.float32]) -> None:
        """Choose the exposure by an image; it stays while the light does, so that edits show."""
        light = self.edit.scene.environment.image
        if self._light is not light:
            self._light, self.display = light, Display(exposure_of(image))
            self._sent.clear()

    def _encoded(
        self, view: str, image: NDArray[np.float32], whole: bool, lossless: bool
    ) -> tuple[Header, bytes]:
        """Encode the rectangle of pixels that a view does not show yet."""
        height, width = image.shape[:2]
        self._expose(image)
        old = None if whole else self._sent.get(view)
        box = _difference(old, image) if old is not None else (0, height, 0, width)
        _keep(self._sent, view, image)
        y0, y1, x0, x1 = box
        size = {"x": x0, "y": y0, "w": x1 - x0, "h": y1 - y0, "width": width, "height": height}
        if y0 >= y1:
            return {"format": "none", **size}, b""
        pixels = self.display(np.ascontiguousarray(image[y0:y1, x0:x1]))
        if lossless:
            return {"format": "png", **size}, _png(pixels)
        if pixels.nbytes <= _RAW:
            return {"format": "rgb", **size}, pixels.tobytes()
        out = io.BytesIO()
        Image.fromarray(pixels).save(out, "JPEG", quality=self.quality, subsampling=0)
        return {"format": "jpeg", **size}, out.getvalue()

    # -- background work -------------------------------------------------------------------

    def _tell(self, by: str) -> None:
        """Tell subscribers soon; later changes until then are told with this one."""
        with self._lock:
            if self._telling is not None:
                self._teller = by if by == self._teller else ""
            elif not self._closed:
                self._teller = by
                self._telling = threading.Timer(_NEWS, self._say)
                self._telling.daemon = True
                self._telling.start()

    def _say(self) -> None:
        with self._lock:
            self._telling = None
            news = {
                "kind": "changed", "by": self._teller, "ready": self.edit.ready,
                "fraction": round(self._fraction, 3),
            }  # fmt: skip
        self._push(news, [])

    def _push(self, header: Header, buffers: list[bytes]) -> None:
        """Tell all subscribers something that they have not asked for."""
        with self._lock:
            pushes = list(self.subscribers.values())
        for push in pushes:
            # a view that is gone: its transport ends the subscription
            with contextlib.suppress(Exception):
                push(dict(header), list(buffers))

    def _refine(self) -> None:
        """Prepare the view in the background, and tell subscribers of its progress."""
        if self._closed:
            return
        if self.refiner is not None and self.refiner.is_alive():
            self._asked = True  # it may have looked for the last time
            return
        self._trouble = ""
        self._fraction = 0.0
        self.refiner = threading.Thread(target=self._prepare, name="traitbrdf-studio", daemon=True)
        self.refiner.start()

    def _prepare(self) -> None:
        """Prepare until the present view is prepared, or an error ends it."""
        while not self._closed:
            if self._dragging:  # the next view replaces this one at once
                time.sleep(0.05)
                continue
            edit = self.edit
            try:
                for _, _, fraction in edit.frames(exact=False):
                    self._fraction = fraction
                    self._tell("")
                    if self.edit is not edit or self._closed or self._dragging:
                        break
            except CancelledError:
                pass
            except Exception as error:
                self._trouble = f"{error}"[:500]
                self._tell("")
                return
            try:
                while self.edit is edit and not (self._closed or self._dragging):
                    self._asked = False
                    if not edit.improve():
                        break
                    self._tell("")
            except Exception as error:
                self._trouble = f"{error}"[:500]
                self._tell("")
            with self._lock:
                if self._closed or (self.edit is edit and edit.ready and not self._asked):
                    self.refiner = None
                    return


def _keep(known: dict[str, T], view: str, value: T) -> None:
    """Remember something of a view, and forget views that were not heard of for long."""
    known.pop(view, None)
    known[view] = value
    while len(known) > _VIEWS:
        known.pop(next(iter(known)))


def _here() -> Path | None:
    """Return the working directory, or None if it was deleted."""
    try:
        return Path.cwd()
    except FileNotFoundError:
        return None


def _numbers(values: object, count: int) -> list[float]:
    """Return the finite numbers of a message; raise on anything else."""
    if not isinstance(values, (list, tuple)) or len(values) != count:
        raise ValueError(f"expected {count} numbers, got {values!r}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"expected a number, got {value!r}")
        if not math.isfinite(value) or abs(value) > 1e6:
            raise ValueError(f"expected a finite number, got {value!r}")
    return [float(value) for value in values]


def _difference(old: NDArray[np.float32], new: NDArray[np.float32]) -> tuple[int, int, int, int]:
    """Return the rows and columns within which two images (H, W, 3) differ, or an empty box."""
    height, width = new.shape[:2]
    if old.shape != new.shape:
        return 0, height, 0, width
    unlike = old.reshape(height, -1) != new.reshape(height, -1)
    rows = np.flatnonzero(unlike.any(axis=1))
    if not len(rows):
        return 0, 0, 0, 0
    y0, y1 = int(rows[0]), int(rows[-1]) + 1
    columns = np.flatnonzero(unlike[y0:y1].any(axis=0))
    return y0, y1, int(columns[0]) // 3, int(columns[-1]) // 3 + 1


def _png(pixels: NDArray[np.uint8]) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", compress_level=1)
    return out.getvalue()
