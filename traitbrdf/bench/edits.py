"""Times of edits and of preparation."""

from __future__ import annotations

import concurrent.futures
import importlib
import itertools
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import maps
from traitbrdf.bench.oracle import reference_values
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.rivals import plain_sums, texel_sum
from traitbrdf.bench.transport import BENCH_CAMERA, WIDE_CAMERA, bench_scene, how_much
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.cache import CACHE_BYTES
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import DRAFT_SIZE, training_of
from traitbrdf.space.library import default_library

Float64 = NDArray[np.float64]

# -- edits ----------------------------------------------------------------------------------------


def edit_speed(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Time edits to finished frames, and the plain sum over environment texels.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, repeats, checked = (64, 8, 4) if quick else (512, 40, 48)
    name, environment = maps(data, True)[0]
    session = EditSession(bench_scene(environment, size), cache=False)
    yield from _edits(session, repeats, checked, 6.0, 3.0, say)
    scene = session.scene
    index = np.flatnonzero(~scene.bordering & (scene.pixel_part < len(scene.shape.parts)))
    index = np.sort(np.random.default_rng(3).choice(index, checked, replace=False))
    brdf = session.brdf("body")
    yield from plain_sums(scene, index, brdf, name, say, {"NumPy": texel_sum})
    if quick:
        return
    del session
    wide = Scene(teapot(), environment, camera=WIDE_CAMERA, size=(1080, 1920), ground=True)
    session = EditSession(wide, cache=False)
    yield from _edits(session, repeats, checked, 33.0, None, say)


def _edits(
    session: EditSession,
    repeats: int,
    checked: int,
    whole: float,
    part: float | None,
    say: Say,
) -> Iterator[Record]:
    """Time the edits of an unprepared session; `whole` and `part` are targets in ms."""
    scene, space = session.scene, session.traits
    named = f"{scene.width}x{scene.height}"
    start = time.perf_counter()
    transport = session.prepare()
    prepared = time.perf_counter() - start
    session.assign(scene.shape.parts, "blue-plastic")
    session.render()
    how = f"{how_much(transport)}, {torch.get_num_threads()} threads"
    say(f"  {how}")
    rng = np.random.default_rng(3)
    home = session.material("body").z
    objects = list(scene.shape.parts)

    def nearby() -> Float64:
        """Return coordinates a small random step away: about a tenth of a trait unit."""
        step = rng.normal(size=len(home))
        return np.asarray(home + 0.05 * step * (session.embedding.high_ - session.embedding.low_)
                          / np.sqrt(len(home)))  # fmt: skip

    def whole_object() -> None:
        session.assign(objects, nearby())

    def every_part() -> None:
        for name in objects:
            session.assign(name, nearby())

    def moved(name: str) -> Callable[[], None]:
        # never the same amount twice, because recent frames are cached
        amounts = ((-1) ** k * (0.05 + 1e-4 * k) for k in itertools.count())
        return lambda: session.move(name, hold=("colour",), shiny=next(amounts))

    assert "shiny" in space.names
    edits: list[tuple[str, Callable[[], None], float | None]] = [
        ("edit of the whole object", whole_object, whole),
        ("edit of all parts, each its own", every_part, None),
        ("edit of the body", moved("body"), None),
        ("edit of the handle", moved("handle"), part),
    ]
    records = []
    for label, edit, target in edits:
        session.assign(objects, "blue-plastic")
        # warm up: the basis may have to learn the material first
        for _ in range(3):
            edit()
            session.render()
        before = session.report()
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            edit()
            session.render()
            times.append(time.perf_counter() - start)
        report = session.report()
        exact = report["exact_frames"] - before["exact_frames"]
        error = frame_error(session, checked, rng)
        tiers = sorted({entry["tier"] for entry in report["parts"].values()})
        value = 1e3 * float(np.median(times))
        said = (
            f"{how}; slowest {1e3 * max(times):.1f} ms, {exact} parts exact in {repeats} edits, "
            f"tiers {' and '.join(tiers)}, stated error {100 * report['frame_error']:.3f} %"
        )
        more: dict[str, Any] = {"error": error, "how": said}
        title = f"{label} to frame, {named}, median"
        records.append(
            Record(title, value, "ms", **more)
            if target is None
            else Record.at_most(title, value, "ms", target, **more)
        )
    yield from records
    yield Record(f"preparation, {named}", prepared, "s", error=records[0].error, how=how)


def frame_error(session: EditSession, count: int, rng: np.random.Generator) -> float:
    """Return the error of a session's frame against the oracle, on some covered pixels.

    Parameters
    ----------
    session : EditSession
    count : int
        Number of pixels.
    rng : numpy.random.Generator
    """
    scene = session.scene
    pixels = np.unique(scene.pixels[rng.choice(len(scene.pixels), count, replace=False)])
    index = np.flatnonzero(np.isin(scene.pixels, pixels))
    materials = [session.material(name) for name in scene.parts]
    distinct = list(dict.fromkeys(materials))
    brdfs = [session.brdf(scene.parts[materials.index(material)]) for material in distinct]
    true, _ = reference_values(scene, index, brdfs, 1e-3)
    own = np.array([distinct.index(material) for material in materials])[scene.pixel_part[index]]
    expected = np.zeros((len(pixels), 3))
    at = np.searchsorted(pixels, scene.pixels[index])
    np.add.at(expected, at, true[np.arange(len(index)), own])
    backdrop = (scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None])[pixels]
    shown = session.render().reshape(-1, 3)[pixels] - backdrop
    known = np.isfinite(expected).all(axis=1)
    return reference.relative_error(shown[known], expected[known])


# -- preparation ----------------------------------------------------------------------------------


def preparation(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure the preparation of a scene in a new process: time, memory, cache, first images.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size = 64 if quick else 512
    name, environment = maps(data, True)[0]
    context = multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool,
    ):
        found = pool.submit(_prepare_afresh, environment, size, folder).result()
    how = f"{found['how']}, map {name}, in a fresh process"
    say(
        f"  {how}; {found['rays']} shadow rays, error of the first frame by its own measurement "
        f"{100 * found['error']:.3f} %"
    )
    yield Record("training set", found["training"], "s", how="once a process")
    yield Record.at_most(
        "preparation", found["prepare"], "s", 15.0, error=found["error"],
        how=f"{how}, the training set at hand",
    )  # fmt: skip
    if found["peak"] is not None:
        yield Record.at_most("peak memory of a preparation", found["peak"], "GB", 1.5, how=how)
    yield Record("preparation from the cache on disk", found["cached"], "s", how=how)
    for change in ("view", "light"):
        seconds, error, width, height = found[change]
        yield Record.at_most(
            f"first image after a change of {change}", seconds, "s", 0.5, error=error,
            how=f"look() and draft(), {width}x{height} enlarged to {size}x{size}; the error is "
            "its own measurement",
        )  # fmt: skip


def _prepare_afresh(environment: EnvironmentMap, size: int, folder: str) -> dict[str, Any]:
    """Return the figures for `preparation`, measured in a process that has done nothing before."""
    os.environ["TRAITBRDF_CACHE"] = folder
    os.environ["TRAITBRDF_CACHE_BYTES"] = str(CACHE_BYTES)
    library = default_library()
    start = time.perf_counter()
    training_of(library, 0)
    training = time.perf_counter() - start
    # warm up: compiled code is loaded (or compiled) at its first use
    warm = EditSession(bench_scene(EnvironmentMap.sky(rows=32), 16), cache=False)
    warm.render()
    warm.draft()
    scene = bench_scene(environment, size)
    session = EditSession(scene)
    start = time.perf_counter()
    transport = session.prepare()
    prepared = time.perf_counter() - start
    peak = peak_memory()
    for thread in threading.enumerate():
        if thread.name == "traitbrdf-cache":
            thread.join()
    again = EditSession(bench_scene(environment, size))
    start = time.perf_counter()
    again.prepare()
    cached = time.perf_counter() - start
    again.assign(scene.shape.parts, "blue-plastic")
    again.render()
    report = again.report()
    if report["prepared_from"] != "cache":
        raise RuntimeError("the preparation was not found in the cache on disk")
    found: dict[str, Any] = {
        "training": training,
        "prepare": prepared,
        "peak": peak,
        "cached": cached,
        "rays": scene.rays_cast,
        "error": report["frame_error"],
        "how": how_much(transport),
    }
    turned = Camera.orbit(-20.0, 25.0, zoom=BENCH_CAMERA.zoom)
    for change, settings in (("view", {"camera": turned}), ("light", {"rotation": 1.0})):
        start = time.perf_counter()
        again.look(**settings)
        image, error = again.draft()
        seconds = time.perf_counter() - start
        small = min(DRAFT_SIZE, size)
        assert image.shape == (size, size, 3)
        found[change] = (seconds, error, small, small)
    return found


def peak_memory() -> float | None:
    """Return the peak memory of this process in GB; None if the system does not report it.

    getrusage is only the fallback: on Linux, children inherit the peak of their parent.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024 / 1e9
    try:
        resource = importlib.import_module("resource")  # there is none on Windows
    except ImportError:
        return None
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak * (1.0 if sys.platform == "darwin" else 1024.0) / 1e9
