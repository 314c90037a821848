"""Editing a scene whose view or light has just changed, or is being changed.

All is measured in one run, beside the machine's own speed: its memory bandwidth, its rays a second
and a fixed kernel. Machines differ from day to day; ratios to these compare.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.bench.datasets import maps
from traitbrdf.bench.edits import peak_memory
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.trade import bandwidth
from traitbrdf.bench.transport import bench_scene
from traitbrdf.formats.files import atomic_path
from traitbrdf.scene.camera import Camera
from traitbrdf.session.cache import CACHE_BYTES, Cache
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import NODES, trained_members, universal_basis
from traitbrdf.transport.operator import Operator, light_tree

_WAIT = 0.02  # seconds between two looks at a preparation


class _Stage(NamedTuple):
    """What is shown from some moment on: frames at some pixels, and how long an edit takes."""

    nodes: int
    seconds: float
    frames: list[NDArray[np.float32]]
    stated: list[float]
    edits: list[float]


_FRESH = """
import time
start = time.perf_counter()
import sys
from pathlib import Path
from traitbrdf.bench.live import first_edit
data = Path(sys.argv[1]) if sys.argv[1] else None
print(*first_edit(start, data, int(sys.argv[2]), int(sys.argv[3])))
"""


class _First(NamedTuple):
    """What a fresh process measured: seconds, the error of a prepared frame, and memory."""

    live: float
    prepared: float
    error: float
    gigabytes: float


def first_edit(start: float, data: Path | None, height: int, width: int) -> _First:
    """Edit a scene as soon as it is live, and prepare it.

    Parameters
    ----------
    start : float
        When the process began, by `time.perf_counter`.
    data : Path or None
    height, width : int
        Pixels.
    """
    found = dict(maps(data, data is None))
    light = found.get("studio") or next(iter(found.values()))
    session = EditSession(bench_scene(light, (height, width)))
    begun = time.perf_counter()
    session.prepare(wait=False)
    while session.view.nodes is None and not session.ready:
        time.sleep(0.01)
    session.assign(session.scene.shape.parts, "red-rubber")
    session.render(wait=False, exact=False)
    live = time.perf_counter() - start
    session.prepare()
    prepared = time.perf_counter() - begun
    memory = peak_memory() or math.nan
    used = set(trained_members(session.library))
    others = [z for i, z in enumerate(session.library.coordinates) if i not in used]
    materials = [others[i] for i in np.linspace(0, len(others) - 1, 8).astype(int)]
    stage = _finished(session, materials)
    error = float(np.median(_errors(session, stage, materials)))
    return _First(live, prepared, error, memory)


def live_edits(
    data: Path | None, quick: bool, say: Say, out: Path | None = None
) -> Iterator[Record]:
    """Measure when edits are live after a change of view or light, and how wrong they are then.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    out : Path or None
        Folder for live.png, the curve of error over time.
    """
    size, count = (64, 4) if quick else (512, 30)
    chosen = [one for one in maps(data, False) if one[0] in ("studio", "forest")]
    chosen = (chosen or maps(data, True))[: 1 if quick else 2]
    kept = {name: os.environ.get(name) for name in ("TRAITBRDF_CACHE", "TRAITBRDF_CACHE_BYTES")}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        os.environ |= {"TRAITBRDF_CACHE": folder, "TRAITBRDF_CACHE_BYTES": str(CACHE_BYTES)}
        try:
            yield from _machine(chosen[0][1], size)
            yield from _changes(chosen, size, count, say, out)
            yield from _drags(chosen, 96 if quick else 256, say)
            yield from _first_scene(data, size)
        finally:
            for thread in threading.enumerate():
                if thread.name == "traitbrdf-cache":
                    thread.join()
            for name, value in kept.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _machine(environment: Any, size: int) -> Iterator[Record]:
    """Measure the machine itself, alone."""
    yield Record("memory bandwidth", bandwidth() / 1e9, "GB/s", how="sum of an array")
    scene = bench_scene(environment, size)
    rng = np.random.default_rng(0)
    count = 1 << 20
    toward = rng.normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    at = np.sort(rng.integers(0, len(scene.normals), count))
    seconds = min(_seconds(lambda: scene.visible(at, toward)) for _ in range(3))
    yield Record("shadow rays", count / seconds / 1e6, "M/s", how="the teapot, all cores")
    numbers = rng.random(1 << 22)
    seconds = min(_seconds(lambda: np.sort(numbers)) for _ in range(3))
    yield Record("fixed kernel", seconds, "s", how="numpy sorts 4 million numbers, one core")


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _drags(chosen: list[Any], size: int, say: Say) -> Iterator[Record]:
    """Measure frames while the camera or the map is dragged, with real materials."""
    names = ("red-rubber", "blue-plastic", "gold-satin", "oak-varnished", "white-plastic")
    for name, environment in chosen:
        session = EditSession(bench_scene(environment, 2 * size), cache=False)
        tree = light_tree(environment)
        for change in ("camera", "map"):
            seconds: list[float] = []
            errors: list[float] = []
            for material in names:
                session.assign(session.scene.shape.parts, material)
                session.glance(size)
                for step in range(1, 13):
                    if change == "camera":
                        wanted: dict[str, Any] = {"camera": Camera.orbit(35 + 3 * step, 20 + step)}
                    else:
                        wanted = {"rotation": 0.06 * step}
                    begun = time.perf_counter()
                    session.look(**wanted)
                    image, _ = session.glance(size)
                    seconds.append(time.perf_counter() - begun)
                    if step % 6 == 0:
                        errors.append(_drag_error(session, image, size, tree))
            error, rate = float(np.median(errors)), 1.0 / float(np.median(seconds))
            say(
                f"  {name}, {change}: slowest frame {1e3 * max(seconds):.0f} ms, greatest error "
                f"{100 * max(errors):.1f} %"
            )
            full = size == 256
            yield Record(
                f"frames a second while the {change} is dragged", rate, "fps",
                10.0 if full else None, rate >= 10.0 and error <= 0.08 if full else None,
                error=error, how=f"{size}x{size} shown at {2 * size}x{2 * size}, map {name}",
            )  # fmt: skip


def _drag_error(session: EditSession, image: Any, size: int, tree: Any) -> float:
    """Return the mean relative L1 of a glance at fragments that its pixels show alone."""
    scene, embedding = session.scene, session.embedding
    small = scene.changed(size=size, subsamples=1)
    some = np.sort(np.random.default_rng(1).choice(len(small.pixels), 200, replace=False))
    operator = Operator(small, embedding.grid_, 1.0, tree)
    true = np.empty((len(some), 3))
    for part, name in enumerate(small.parts):
        mine = small.pixel_part[some] == part
        if mine.any():
            table = session.material(name).values(embedding)
            true[mine] = np.einsum("pcc->pc", operator.images(some[mine], table))
    # the enlarged image has four pixels for each
    shown = image.reshape(size, 2, size, 2, 3).mean(axis=(1, 3)).reshape(-1, 3)[small.pixels[some]]
    return float(np.abs(shown - true).mean() / true.mean())


def _first_scene(data: Path | None, size: int) -> Iterator[Record]:
    """Measure fresh processes: the first live edit, the whole preparation and its memory."""
    full = size == 512
    for height, width in ((size, size), (1080, 1920)) if full else ((size, size),):
        command = [sys.executable, "-c", _FRESH, "" if data is None else str(data)]
        command += [str(height), str(width)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=900)
        first = _First(*(float(word) for word in done.stdout.split()[-4:]))
        how = f"{width}x{height}, map studio or the first"
        small = full and width == size
        yield Record(
            "first live edit of a fresh process", first.live, "s", 4.0 if small else None,
            first.live <= 4.0 if small else None, how=f"{how}, imports included",
        )  # fmt: skip
        yield Record(
            "a fresh process prepares", first.prepared, "s", error=first.error,
            how=f"{how}, 8 unseen materials",
        )  # fmt: skip
        asked = (1.0 if small else 3.0) if full else None
        yield Record(
            "peak memory until then", first.gigabytes, "GB", asked,
            None if asked is None else first.gigabytes <= asked, how=how,
        )  # fmt: skip


def _changes(
    chosen: list[Any], size: int, count: int, say: Say, out: Path | None
) -> Iterator[Record]:
    session = EditSession(bench_scene(chosen[0][1], size))
    library, cache = session.library, Cache.usual()
    if cache is not None:
        start = time.perf_counter()
        universal_basis(library, 0, cache, lambda stage, fraction: None)
        seconds = time.perf_counter() - start
        yield Record("universal basis", seconds, "s", how="once, training set included")
    used = set(trained_members(library))
    others = [i for i in range(len(library)) if i not in used]
    materials = [
        library.coordinates[others[i]] for i in np.linspace(0, len(others) - 1, count).astype(int)
    ]
    turned = Camera.orbit(-20.0, 25.0, zoom=session.scene.camera.zoom)
    session.draft()  # loads compiled code
    curves: dict[str, list[tuple[float, float, float]]] = {}
    for name, environment in chosen:
        for change, wanted in (
            ("light", {"environment": environment, "rotation": 1.0}),
            ("view", {"environment": environment, "camera": turned}),
        ):
            before, stages = _follow(session, wanted, materials)
            errors = [_errors(session, stage, materials) for stage in stages]
            if change == "light":
                stages.append(_finished(session, materials))
                errors.append(_errors(session, stages[-1], materials))
            session.cancel()
            curves[f"{name}, {change}"] = [
                (s.seconds, float(np.median(e)), float(np.percentile(e, 95)))
                for s, e in zip(stages, errors, strict=True)
            ]
            how = f"{size}x{size}, map {name}, {count} unseen materials, preparation running behind"
            for i, (stage, error) in enumerate(zip(stages, errors, strict=True)):
                median, worst = float(np.median(error)), float(np.max(error))
                say(
                    f"  {change}, {stage.nodes} nodes after {stage.seconds:.2f} s: error "
                    f"{100 * median:.2f} % (95th percentile {100 * np.percentile(error, 95):.2f}, "
                    f"greatest {100 * worst:.2f}; stated {100 * np.median(stage.stated):.2f})"
                )
                full = size == 512
                if i == len(NODES):
                    yield Record(
                        f"prepared after a change of {change}", stage.seconds, "s",
                        20.0 if full else None,
                        stage.seconds <= 20.0 and median <= 0.003 if full else None,
                        error=median, how=how,
                    )  # fmt: skip
                    continue
                yield Record(
                    f"live after a change of {change}, {NODES[i]} nodes", stage.seconds, "s",
                    (1.5, 5.0)[i] if full else None,
                    stage.seconds <= (1.5, 5.0)[i] and median <= (0.05, 0.02)[i] if full else None,
                    error=median, how=how,
                )  # fmt: skip
                edit = 1e3 * float(np.median(stage.edits))
                yield Record(
                    f"edit to frame after a change of {change}, {NODES[i]} nodes", edit, "ms",
                    33.0 if full else None,
                    edit <= 33.0 if full else None, error=median, how=how,
                )  # fmt: skip
            yield Record(f"draft of an edit without nodes, {change}", before, "s", how=how)
    yield from _by_bandwidth(session, materials)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        with atomic_path(out / "live.png") as temporary:
            _plot(temporary, curves, count)
        say(f"  wrote {out / 'live.png'}")


def _plot(path: Path, curves: dict[str, list[tuple[float, float, float]]], count: int) -> None:
    """Plot the error of frames over the time since a change."""
    try:
        figure = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise RuntimeError("the plot needs matplotlib: pip install traitbrdf[plots]") from error
    page = figure.Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = page.subplots()
    for i, (label, points) in enumerate(curves.items()):
        at = [point[0] for point in points]
        axes.step(at, [100 * p[1] for p in points], f"C{i}o-", where="post", label=label)
        axes.step(at, [100 * p[2] for p in points], f"C{i}:", where="post", lw=0.8)
    axes.set(
        xscale="log", yscale="log", xlabel="seconds since the change", ylabel="error of a frame, %"
    )
    axes.set_title(f"median of {count} unseen materials (dotted: 95th percentile)", fontsize=10)
    axes.legend(fontsize=8)
    page.savefig(path, dpi=110, format="png")


def _finished(session: EditSession, materials: list[NDArray[np.float64]]) -> _Stage:
    """Wait until the view is prepared; collect frames of all materials."""
    session.prepare()
    # the edits of the stages before took time from the preparation, which goes on behind
    seconds = session.view.times["prepare"]
    return _shown(
        session, materials, _Stage(0, seconds, [], [], []),
        lambda: (session.render(exact=False), session.frame_error or 0.0),
    )  # fmt: skip


def _shown(
    session: EditSession,
    materials: list[NDArray[np.float64]],
    stage: _Stage,
    draw: Callable[[], tuple[NDArray[np.float32], float]],
) -> _Stage:
    """Edit the shape to each material; add to a stage what is shown, its error and the time."""
    places = _pixels(session)[1]
    for material in materials:
        begun = time.perf_counter()
        session.assign(session.scene.shape.parts, material)
        image, stated = draw()
        stage.edits.append(time.perf_counter() - begun)
        stage.frames.append(image.reshape(-1, 3)[places])
        stage.stated.append(stated)
        session.undo()
    return stage


def _follow(
    session: EditSession, wanted: dict[str, Any], materials: list[NDArray[np.float64]]
) -> tuple[float, list[_Stage]]:
    """Change view or light; collect frames of all materials at each number of nodes."""
    parts = session.scene.shape.parts
    start = time.perf_counter()
    session.look(**wanted)
    stages: list[_Stage] = []
    session.prepare(wait=False)
    for _ in NODES:
        known = stages[-1].nodes if stages else 0
        while session.view.nodes is None or len(session.view.nodes.nodes) <= known:
            if session.ready:
                raise RuntimeError("the view was prepared before its nodes were seen")
            time.sleep(_WAIT)
        nodes = session.view.nodes
        session.draft()
        stage = _Stage(len(nodes.nodes), time.perf_counter() - start, [], [], [])
        stages.append(_shown(session, materials, stage, session.draft))
    session.assign(parts, materials[0])
    begun = time.perf_counter()
    session.draft(128)  # loads the small scene
    session.assign(parts, materials[-1])
    begun = time.perf_counter()
    session.draft(128)
    before = time.perf_counter() - begun
    session.undo()
    session.undo()
    return before, stages


def _by_bandwidth(session: EditSession, materials: list[NDArray[np.float64]]) -> Iterator[Record]:
    """Measure frames of a prepared view beside the time in which memory gives what they read."""
    transport, parts = session.prepare(), session.scene.shape.parts
    rate = bandwidth()
    basis = transport.bases[0]
    tables = [
        torch.from_numpy(session.embedding.decode_values(z)[transport.cells]) for z in materials
    ]
    for name, some in (("whole object", parts), (f"one part, {parts[2]}", parts[2:3])):
        at = [session.scene.parts.index(part) for part in some]
        spans = [session.scene.part_slice(part) for part in at]
        images = sum(span.stop - span.start for span in spans) * basis.basis[0].nbytes
        bound = (images + basis.rows.nbytes) / rate

        def shade(i: int, at: list[int] = at) -> None:
            for part in at:
                transport.shade(part, tables[i])

        def edit(i: int, some: Sequence[str] = some) -> None:
            amount = 0.1 + 0.002 * i  # never back to a frame that is still known
            session.move(some, shiny=amount if i % 2 else -amount)
            session.render(exact=False)

        for what, call, limit in (("frame", shade, 1.5), ("move to frame", edit, None)):
            session.assign(parts, materials[0])
            call(1)
            calls = [functools.partial(call, i) for i in range(len(tables))]
            seconds = float(np.median([_seconds(one) for one in calls]))
            yield Record(
                f"{what} of prepared images, by what its bytes need", seconds / bound, "times",
                limit, None if limit is None else seconds / bound <= limit,
                how=f"{name}: {1e3 * seconds:.2f} ms, {bound * rate / 1e6:.0f} MB",
            )  # fmt: skip


def _pixels(session: EditSession) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return some fragments that fill their pixels alone, and these pixels."""
    scene = session.scene
    several = np.bincount(scene.pixels, minlength=scene.height * scene.width) > 1
    alone = np.flatnonzero(~several[scene.pixels] & (scene.weights == 1.0))
    rng = np.random.default_rng(4)
    some = np.sort(rng.permutation(alone)[:400])
    return some, scene.pixels[some]


def _errors(
    session: EditSession, stage: _Stage, materials: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the mean relative L1 of each material's frame against the operator, twice as fine."""
    some, _ = _pixels(session)
    scene, embedding = session.scene, session.embedding
    operator = Operator(scene, embedding.grid_, 2.0)
    own = scene.pixel_part[some] < len(scene.shape.parts)
    tables = np.concatenate([embedding.decode_values(z) for z in materials], axis=1)
    shown = operator.images(some, np.ascontiguousarray(tables))
    ground = session.material(scene.parts[-1]).values(embedding)
    under = np.einsum("ncc->nc", operator.images(some, ground))
    errors = []
    for i, frame in enumerate(stage.frames):
        true = np.stack([shown[:, c, 3 * i + c] for c in range(3)], axis=1)
        true[~own] = under[~own]
        errors.append(np.abs(frame - true).mean() / true.mean())
    return np.array(errors)
