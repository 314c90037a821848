"""The same frames by other methods: a plain sum over texels, and Mitsuba 3."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench import peers
from traitbrdf.bench.datasets import maps
from traitbrdf.bench.oracle import Oracle, draw_fragments, reference_values
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.transport import BENCH_CAMERA, how_much
from traitbrdf.directions import shading_frame, to_local
from traitbrdf.export.mitsuba import fit_lobe
from traitbrdf.reflectance.brdf import (
    TabulatedBRDF,
)
from traitbrdf.scene.lights import EnvironmentMap, texel_moments
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.editing import EditSession
from traitbrdf.session.preparation import training_of
from traitbrdf.space.library import default_library

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

PEER_MATERIALS = ("blue-plastic", "gold-polished", "red-rubber")
"""Library members whose edits are compared with Mitsuba's: glossy, sharp and dull."""

_SEEDS = 16  # frames over which the error of a number of samples is averaged
_MANY = 16384  # samples per pixel that count as converged


def texel_sum(scene: Scene, index: Int64, brdf: TabulatedBRDF) -> Float64:
    """Return radiance (m, 3) by one look-up per texel, at its centre, without shadows.

    Parameters
    ----------
    scene : Scene
    index : (m,) int array
        Fragments of one sample each.
    brdf : TabulatedBRDF
    """
    environment = scene.environment
    moment = texel_moments(environment).reshape(-1, 3)
    omega = np.linalg.norm(moment, axis=-1, keepdims=True)
    toward = moment / omega
    energy = environment.image.reshape(-1, 3) * omega
    result = np.zeros((len(index), 3))
    for i, p in enumerate(scene.offsets[index]):
        normal = environment.to_map(scene.normals[p])
        view = environment.to_map(scene.views[p])
        above = toward @ normal > 0.0
        wi = to_local(toward[above], np.broadcast_to(normal, toward[above].shape))
        wo = to_local(view, normal)
        f = brdf.eval(wi, np.broadcast_to(wo, wi.shape))
        result[i] = np.sum(f * energy[above] * wi[:, 2:], axis=0)
    return result


def texel_sum_torch(scene: Scene, index: Int64, brdf: TabulatedBRDF) -> Float64:
    """Compute `texel_sum` in torch and float32.

    Parameters
    ----------
    scene : Scene
    index : (m,) int array
        Fragments of one sample each.
    brdf : TabulatedBRDF
        On a folded grid.

    Raises
    ------
    ValueError
        If it is on another grid.
    """
    grid, environment = brdf.grid, scene.environment
    if grid.layout != "folded":
        raise ValueError(f"brdf: expected a table on a folded grid, got {brdf!r}")
    n_h, n_d, n_p = grid.shape
    table = torch.from_numpy(np.ascontiguousarray(brdf.values.reshape(-1, 3), np.float32))
    nodes = torch.from_numpy(grid.theta_h.astype(np.float32))
    moment = texel_moments(environment).reshape(-1, 3)
    omega = np.linalg.norm(moment, axis=-1, keepdims=True)
    toward = torch.from_numpy((moment / omega).astype(np.float32))
    energy = torch.from_numpy((environment.image.reshape(-1, 3) * omega).astype(np.float32))

    def bracket(x: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        low = x.long().clamp_(0, count - 2)
        return low, (x - low).clamp_(0.0, 1.0)

    first = scene.offsets[index]
    normals = np.asarray(environment.to_map(scene.normals[first]), np.float64)
    views = to_local(environment.to_map(scene.views[first]), normals)
    frames = np.stack([*shading_frame(normals), normals], axis=-1)
    result = torch.zeros(len(index), 3, dtype=torch.float64)
    for start in range(0, len(index), 8):
        some = slice(start, start + 8)
        local = toward @ torch.from_numpy(frames[some].astype(np.float32))
        which, texel = torch.nonzero(local[..., 2] > 0.0, as_tuple=True)
        wi = local[which, texel]
        wo = torch.from_numpy(views[some].astype(np.float32))[which]
        x, y, z = wi.unbind(1)
        total = wi + wo
        length = total.norm(dim=1)
        h_x, h_y, h_z = (total / length[:, None]).unbind(1)
        slant = torch.hypot(h_x, h_y)
        c, s = h_x / slant.clamp_min(1e-30), h_y / slant.clamp_min(1e-30)
        theta_h = torch.atan2(slant, h_z)
        theta_d = torch.atan2((wi - wo).norm(dim=1), length)
        phi_d = torch.atan2(c * y - s * x, h_z * (c * x + s * y) - slant * z).abs()
        phi_d = torch.minimum(phi_d, math.pi - phi_d)
        a, _ = bracket((theta_h * (2.0 / math.pi)).sqrt() * (n_h - 1), n_h)
        f_a = ((theta_h - nodes[a]) / (nodes[a + 1] - nodes[a])).clamp_(0.0, 1.0)
        b, f_b = bracket(theta_d * (2.0 / math.pi * (n_d - 1)), n_d)
        e, f_e = bracket(phi_d * (2.0 / math.pi * (n_p - 1)), n_p)
        cell = (a * n_d + b) * n_p + e
        corners = [
            (cell + (da * n_d + db) * n_p + de, w_a * w_b * w_e)
            for da, w_a in ((0, 1.0 - f_a), (1, f_a))
            for db, w_b in ((0, 1.0 - f_b), (1, f_b))
            for de, w_e in ((0, 1.0 - f_e), (1, f_e))
        ]
        f = torch.nn.functional.embedding_bag(
            torch.stack([at for at, _ in corners], dim=1),
            table,
            per_sample_weights=torch.stack([weight for _, weight in corners], dim=1),
            mode="sum",
        )
        result[some].index_add_(0, which, (f * energy[texel] * z[:, None]).double())
    return result.numpy()


def plain_sums(
    scene: Scene,
    index: Int64,
    brdf: TabulatedBRDF,
    map_name: str,
    say: Say,
    sums: Mapping[str, Callable[[Scene, Int64, TabulatedBRDF], Float64]],
) -> Iterator[Record]:
    """Time plain sums over texels, and scale the time to a whole frame.

    Parameters
    ----------
    scene : Scene
    index : (m,) int array
        Fragments of one sample each, which are computed.
    brdf : TabulatedBRDF
    map_name : str
    say : callable
    sums : mapping of str to callable
        Implementations such as `texel_sum`, by the name of what runs them.

    Raises
    ------
    ArithmeticError
        If the results of two implementations differ by more than 0.1 %.
    """
    bare = scene.changed(shadows=False)
    true, _ = reference_values(bare, index, [brdf], 1e-3)
    first: Float64 | None = None
    for label, call in sums.items():
        # a warm-up call
        call(bare, index[:8], brdf)
        start = time.perf_counter()
        plain = call(bare, index, brdf)
        seconds = (time.perf_counter() - start) / len(index) * len(scene.pixels)
        if first is None:
            first = plain
        apart = reference.relative_error(plain, first)
        if apart > 1e-3:
            raise ArithmeticError(f"the sum in {label} is {100 * apart:.2f} % off the first one")
        if plain is not first:
            say(f"  the sum in {label} is within {100 * apart:.4f} % of the first one")
        yield Record(
            f"plain sum over texels{'' if label == 'NumPy' else f' in {label}'}, a frame",
            1e3 * seconds, "ms",
            error=reference.relative_error(plain, true[:, 0]),
            how=f"{label}, without shadows, {len(index)} fragments, scaled to {len(scene.pixels)}; "
            f"map {map_name}, {torch.get_num_threads()} threads",
        )  # fmt: skip


# -- comparison with another renderer -------------------------------------------------------------


@dataclass(frozen=True)
class _Edited:
    """Our edits of the whole object; the last one assigns a member of the library."""

    seconds: Float64
    frame: Float32  # (H * W, 3), the last one
    brdf: TabulatedBRDF
    how: str


def peer_speed(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Compare an edit's time to its frame with Mitsuba 3 at its best settings and equal error.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    peer = peers.load()
    size, count, repeats = (64, 40, 6) if quick else (512, 300, 30)
    aims = (0.02,) if quick else (0.05, 0.01)
    map_name, environment = maps(data, True)[0]
    start = time.perf_counter()
    training_of(default_library(), 0)
    training = time.perf_counter() - start
    # warm up: compiled code is loaded (or compiled) at its first use
    EditSession(Scene(teapot(), EnvironmentMap.sky(rows=32), size=16), cache=False).render()
    # no ground: Mitsuba's would hide the lower half of the map from the object
    session = EditSession(Scene(teapot(), environment, camera=BENCH_CAMERA, size=size), cache=False)
    scene = session.scene
    start = time.perf_counter()
    transport = session.prepare()
    our_start = training + time.perf_counter() - start
    rng = np.random.default_rng(3)
    edited = {name: _edit_whole(session, name, repeats, rng) for name in PEER_MATERIALS}
    tables = [mine.brdf for mine in edited.values()]

    index = np.flatnonzero(~scene.bordering)
    first = scene.offsets[index]
    index = index[np.sum(scene.normals[first] * scene.views[first], axis=-1) > 0.15]
    with Oracle(tables) as oracle:
        index, true, own = draw_fragments(oracle, scene, index, count, rng)
    pixels = scene.pixels[index]
    where = (
        f"teapot with shadows, {size}x{size}, map {map_name}, errors on {len(index)} interior "
        f"pixels, the oracle's own {100 * own.mean() / true.mean():.3f} %, "
        f"{torch.get_num_threads()} threads"
    )
    say(f"  {where}")

    start = time.perf_counter()
    material = peer.material(tables[0], *fit_lobe(tables[0]))
    theirs = peers.their_scene(peer.mi, scene, material)
    covered = np.unique(scene.pixels)
    peers.traced(peer, theirs, scene, covered, 1, 0)
    their_start = time.perf_counter() - start
    versus = (
        f"Mitsuba {peer.mi.__version__} {peers.VARIANT}, multijitter, MIS compensation, a lobe "
        f"fitted to the table, each texel {peers.FINER}x{peers.FINER} of theirs, only the "
        f"{len(covered)} covered pixels, through their centres"
    )
    say(f"  {versus}")

    ratios: dict[float, list[float]] = {aim: [] for aim in aims}
    ahead: dict[float, list[float]] = {aim: [] for aim in aims}
    converged = []
    for b, (name, mine) in enumerate(edited.items()):
        our_error = reference.relative_error(mine.frame[pixels], true[:, b])
        ours = float(np.median(mine.seconds))
        yield Record(
            f"ours, {name}, edit to frame", 1e3 * ours, "ms", error=our_error,
            how=f"{how_much(transport)}, {mine.how}",
        )  # fmt: skip
        rival = _Rival(peer, theirs, material, scene, pixels, mine.brdf, true[:, b])
        converged.append(rival.converged())
        if converged[-1] > 0.02:
            raise ArithmeticError(
                f"{name}: Mitsuba converges to {100 * converged[-1]:.1f} % off the reference"
            )
        say(f"  {name}: lobe of roughness {rival.lobe[0]:.3g}, {100 * rival.lobe[1]:.0f} % even")
        seconds, error = rival.frame(1)
        yield Record(
            f"Mitsuba, {name}, one sample a pixel", 1e3 * seconds, "ms", error=error, how=versus
        )
        for aim in aims:
            samples, expected = rival.samples_for(aim)
            seconds, error = rival.frame(samples)
            yield Record(
                f"Mitsuba, {name}, frame at {100 * aim:g} %", seconds, "s", error=error,
                how=f"{samples} samples a pixel, by which {_SEEDS} seeds err by "
                f"{100 * expected:.3f} %; {versus}",
            )  # fmt: skip
            ratios[aim].append(seconds / ours)
            ahead[aim].append(
                max(1.0, math.floor((our_start - their_start) / (seconds - ours)) + 1.0)
            )
            yield Record(
                f"faster than Mitsuba, {name}, at {100 * aim:g} %", ratios[aim][-1], "x",
                error=our_error, how=where,
            )  # fmt: skip
    for aim in aims:
        least = min(ratios[aim])
        title = f"faster than Mitsuba, least, at {100 * aim:g} %"
        how = f"of {', '.join(PEER_MATERIALS)}; {where}"
        yield (
            Record.at_least(title, least, "x", 1000.0, how=how)
            if aim == 0.01
            else Record(title, least, "x", how=how)
        )
        yield Record(
            f"edits until we are ahead, most, at {100 * aim:g} %", max(ahead[aim]), "", how=how
        )
    yield Record(
        "preparation, ours", our_start, "s",
        how=f"{how_much(transport)}; {training:.1f} s of it for the training set, once a process",
    )  # fmt: skip
    yield Record(
        "preparation, Mitsuba", their_start, "s",
        how=f"scene and kernels, these compiled or from its own cache on disk; {versus}",
    )  # fmt: skip
    yield Record(
        "Mitsuba, converged, against our reference", 100.0 * max(converged), "%",
        how=f"4 times {_MANY} samples a pixel, their noise included, worst of "
        f"{', '.join(PEER_MATERIALS)}; {where}",
    )  # fmt: skip
    few = index[:: max(1, len(index) // (4 if quick else 48))]
    sums = {"NumPy": texel_sum, "torch": texel_sum_torch}
    yield from plain_sums(scene, few, tables[0], map_name, say, sums)


def _edit_whole(session: EditSession, name: str, repeats: int, rng: np.random.Generator) -> _Edited:
    """Time edits of the whole object near a library member; the last one assigns that member."""
    objects = list(session.scene.shape.parts)
    session.assign(objects, name)
    home = session.material(objects[0]).z
    span = session.embedding.high_ - session.embedding.low_

    def nearby() -> Float64:
        return np.asarray(home + 0.05 * rng.normal(size=len(home)) * span / np.sqrt(len(home)))

    # warm up: the basis may have to learn the material first
    for _ in range(3):
        session.assign(objects, nearby())
        session.render()
    before = session.report()["exact_frames"]
    wanted: list[str | Float64] = [*(nearby() for _ in range(repeats - 1)), name]
    seconds = []
    for material in wanted:
        start = time.perf_counter()
        session.assign(objects, material)
        frame = session.render()
        seconds.append(time.perf_counter() - start)
    report = session.report()
    exact = report["exact_frames"] - before
    how = (
        f"median of {repeats} edits of the whole object, slowest {1e3 * max(seconds):.1f} ms, "
        f"{exact} parts exact in them; the error is the last one's"
    )
    return _Edited(np.array(seconds), frame.reshape(-1, 3), session.brdf(objects[0]), how)


class _Rival:
    """Mitsuba on one table: timed frames, and their errors at interior `pixels` (m,)."""

    def __init__(
        self,
        peer: peers.Peer,
        theirs: Any,
        material: Any,
        scene: Scene,
        pixels: Int64,
        table: TabulatedBRDF,
        true: Float64,
    ) -> None:
        self.peer, self.theirs, self.material = peer, theirs, material
        self.scene, self.pixels, self.true = scene, pixels, true
        self.table, self.lobe = table, fit_lobe(table)
        self.covered = np.unique(scene.pixels)
        self._seeds = itertools.count(1)

    def frame(self, samples: int) -> tuple[float, float]:
        """Return the seconds from an edit to its frame, and the error of that frame."""
        self._trace(self.pixels[:16], samples)  # compiles a kernel for this number of samples
        start = time.perf_counter()
        self.material.assign(self.table, *self.lobe)
        image = self._trace(self.covered, samples)
        seconds = time.perf_counter() - start
        return seconds, self._error(image[np.searchsorted(self.covered, self.pixels)])

    def converged(self) -> float:
        """Return the error at many samples; it still includes their noise."""
        self.material.assign(self.table, *self.lobe)
        runs = [self._trace(self.pixels, peers.rounded(self.peer, _MANY)) for _ in range(4)]
        return self._error(np.mean(runs, axis=0))

    def samples_for(self, aim: float) -> tuple[int, float]:
        """Return the samples per pixel at which the mean error is about `aim`, and that error."""
        self.material.assign(self.table, *self.lobe)
        few, many = 1, 4
        more, less = self._expected(few), self._expected(many)
        while less > aim:
            few, many, more = many, 4 * many, less
            if many > _MANY:
                raise ArithmeticError(
                    f"{self.table!r}: Mitsuba errs by {100 * less:.2f} % with {few} samples a pixel"
                )
            less = self._expected(many)
        share = math.log(more / aim) / math.log(more / less)
        found: list[tuple[int, float]] = []
        wanted = few * (many / few) ** share
        for _ in range(2):
            samples = peers.rounded(self.peer, round(wanted))
            found.append((samples, self._expected(samples)))
            wanted = samples * (found[-1][1] / aim) ** 2
        return min(found, key=lambda pair: abs(pair[1] - aim))

    def _expected(self, samples: int) -> float:
        """Return the mean error of frames with several seeds."""
        samples = peers.rounded(self.peer, samples)
        return float(
            np.mean([self._error(self._trace(self.pixels, samples)) for _ in range(_SEEDS)])
        )

    def _trace(self, pixels: Int64, samples: int) -> Float64:
        return peers.traced(self.peer, self.theirs, self.scene, pixels, samples, next(self._seeds))

    def _error(self, shown: Float64) -> float:
        return reference.relative_error(shown, self.true)
