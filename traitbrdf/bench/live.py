"""Time to the first live edit after a change of view or light."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf.bench.datasets import maps
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.transport import bench_scene
from traitbrdf.scene.camera import Camera
from traitbrdf.session.cache import CACHE_BYTES, Cache
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import NODES, trained_members, universal_basis
from traitbrdf.transport.operator import Operator

_WAIT = 0.02  # seconds between two looks at a preparation


class _Stage(NamedTuple):
    """What is shown from some moment on: frames at some pixels, and how long an edit takes."""

    nodes: int
    seconds: float
    frames: list[NDArray[np.float32]]
    stated: list[float]
    edits: list[float]


def live_edits(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure when edits are live after a change of view or light, and how wrong they are then.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, count = (64, 4) if quick else (512, 30)
    chosen = [one for one in maps(data, False) if one[0] in ("studio", "forest")]
    chosen = (chosen or maps(data, True))[: 1 if quick else 2]
    kept = {name: os.environ.get(name) for name in ("TRAITBRDF_CACHE", "TRAITBRDF_CACHE_BYTES")}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        os.environ |= {"TRAITBRDF_CACHE": folder, "TRAITBRDF_CACHE_BYTES": str(CACHE_BYTES)}
        try:
            yield from _changes(chosen, size, count, say)
        finally:
            for thread in threading.enumerate():
                if thread.name == "traitbrdf-cache":
                    thread.join()
            for name, value in kept.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _changes(chosen: list[Any], size: int, count: int, say: Say) -> Iterator[Record]:
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
    for name, environment in chosen:
        for change, wanted in (
            ("light", {"environment": environment, "rotation": 1.0}),
            ("view", {"environment": environment, "camera": turned}),
        ):
            before, stages = _follow(session, wanted, materials)
            errors = [_errors(session, stage, materials) for stage in stages]
            session.cancel()
            how = f"{size}x{size}, map {name}, {count} unseen materials, preparation running behind"
            for i, (stage, error) in enumerate(zip(stages, errors, strict=True)):
                median, worst = float(np.median(error)), float(np.max(error))
                say(
                    f"  {change}, {stage.nodes} nodes after {stage.seconds:.2f} s: error "
                    f"{100 * median:.2f} % (95th percentile {100 * np.percentile(error, 95):.2f}, "
                    f"greatest {100 * worst:.2f}; stated {100 * np.median(stage.stated):.2f})"
                )
                full = size == 512
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
        places = _pixels(session)[1]
        for material in materials:
            begun = time.perf_counter()
            session.assign(parts, material)
            image, stated = session.draft()
            stage.edits.append(time.perf_counter() - begun)
            stage.frames.append(image.reshape(-1, 3)[places])
            stage.stated.append(stated)
            session.undo()
        stages.append(stage)
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
