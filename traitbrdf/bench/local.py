"""Local paint: times from a stroke's sample to its frame, and errors of painted pixels."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import maps
from traitbrdf.bench.records import Record, Say
from traitbrdf.bench.transport import bench_scene
from traitbrdf.design.effects import Assign, Effect, Move, Tint
from traitbrdf.design.masks import Local
from traitbrdf.design.strokes import Stroke
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.formats.display import exposure_of
from traitbrdf.reflectance.descriptors import cielab
from traitbrdf.session.editing import EditSession

Float64 = NDArray[np.float64]

_LAYERS: tuple[tuple[list[tuple[float, float]], float, Effect, float], ...] = (
    ([(0.31, 0.47), (0.47, 0.59), (0.64, 0.51)], 0.10, Move(shiny=0.6), 1.0),
    ([(0.39, 0.43), (0.43, 0.70)], 0.08, Assign("gold-polished"), 0.7),
    ([(0.35, 0.64), (0.64, 0.64)], 0.09, Move(metallic=0.5), 1.0),
)
"""Three layers that cross on the body: points and radius in shares of the image, opacity."""


def local_paint(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Paint locally: sample to frame, old layers changed, errors against the oracle.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, checked = (96, 12) if quick else (512, 300)
    some = maps(data, quick)
    studio = [pair for pair in some if pair[0] == "studio"] or some[:1]
    others = [pair for pair in some if pair not in studio]
    for name, environment in [*studio, *others][: 1 if quick else 3]:
        edit = EditSession(bench_scene(environment, size), cache=False)
        edit.prepare()
        if (name, environment) in studio:
            yield from _times(edit, name, say)
        yield from _errors(edit, name, checked, say)


def _painted(edit: EditSession, layers: int) -> None:
    """Paint some of the layers on a red teapot, as a hand does that rests after each."""
    while edit.undo():
        pass
    edit.assign(edit.scene.shape.parts, "red-rubber")
    for points, radius, effect, opacity in _LAYERS[:layers]:
        edit.paint(_stroke(edit, points, radius), effect, where="local")
        edit.layers[-1].opacity = opacity
        edit.render()


def _stroke(edit: EditSession, points: Sequence[tuple[float, float]], radius: float) -> Stroke:
    side = edit.scene.height
    return Stroke([(x * side, y * side) for x, y in points], radius=radius * side)


def _samples(
    edit: EditSession, where: str, effect: Effect, points: Sequence[tuple[float, float]]
) -> list[float]:
    """Paint a stroke sample by sample, as the canvas does; return milliseconds to each frame.

    The canvas keeps the stroke of a hand that is down and extends it by each sample.
    """
    side, stroke = edit.scene.height, _stroke(edit, points[:1], 0.125)
    times = []
    for count, (x, y) in enumerate(points[1:]):
        start = time.perf_counter()
        stroke = stroke.extended([(x * side, y * side)])
        if count:
            edit.undo()
        edit.paint(stroke, effect, where=where)
        edit.render(exact=False)
        times.append(1e3 * (time.perf_counter() - start))
    return times


def _times(edit: EditSession, name: str, say: Say) -> Iterator[Record]:
    scene = edit.scene
    way = np.linspace(0.0, 1.0, 60)
    wave = [(0.3 + 0.36 * t, 0.56 + 0.08 * np.sin(6.0 * t)) for t in way]
    how = f"{scene.width}x{scene.height}, map {name}, radius {0.125 * scene.height:.0f} pixels"
    # moves are compiled before
    _painted(edit, 1)
    edit.move("lid", shiny=0.1)
    for where, layers, median, most in (
        ("part", 0, 16.0, None), ("local", 0, 25.0, 40.0), ("local", 3, 25.0, 40.0)
    ):  # fmt: skip
        _painted(edit, layers)
        times = _samples(edit, where, Move(dusty=0.5), wave)
        live = edit.report()["frame_error"]
        said = f"{how}, {layers} local layers below; first {times[0]:.0f} ms, most {max(times):.0f}"
        title = f"sample to frame, {where}, {layers} layers below"
        yield Record.at_most(
            f"{title}, median", float(np.median(times)), "ms", median, error=live, how=said
        )
        if most is not None:
            late = float(np.percentile(times, 95))
            yield Record.at_most(
                f"{title}, 95th percentile", late, "ms", most, error=live, how=said
            )
    _painted(edit, 3)
    times = []
    for share in np.linspace(0.95, 0.3, 14):
        start = time.perf_counter()
        edit.layers[1].opacity = float(share)
        edit.render(exact=False)
        times.append(1e3 * (time.perf_counter() - start))
    yield Record.at_most(
        "opacity of an old layer to frame, median", float(np.median(times)), "ms", 33.0,
        error=edit.report()["frame_error"], how=f"{how}, two layers above; most {max(times):.0f}",
    )  # fmt: skip
    yield _edges(edit, name)


def _errors(edit: EditSession, name: str, checked: int, say: Say) -> Iterator[Record]:
    """Compare painted pixels with the oracle, each with the material that it has."""
    for layers in (1, 3):
        _painted(edit, layers)
        start = time.perf_counter()
        while edit.improve():  # the hand rests
            pass
        frame, scene = edit.render(), edit.scene
        seconds = time.perf_counter() - start
        stated = edit.report()["painted"]["error"]
        covers = np.bincount(scene.pixels, minlength=frame[..., 0].size)
        found = np.flatnonzero((covers[scene.pixels] == 1) & ~scene.bordering)
        y, x = np.divmod(scene.pixels[found], scene.width)
        bare = _without(edit)
        different = (frame != bare).any(axis=2)[y, x]
        rng = np.random.default_rng(7)
        chosen = rng.choice(np.flatnonzero(different), checked, replace=False)
        shown, exact = [], []
        for i in chosen:
            seen = edit.pick(x[i] + 0.5, y[i] + 0.5)
            if seen is None:
                continue
            brdf = edit.brdf(seen.part, at=(x[i] + 0.5, y[i] + 0.5))
            exact.append(reference.fragments(scene, [found[i]], [brdf])[0][0, 0])
            shown.append(frame[y[i], x[i]])
        off = np.abs(np.array(shown) - exact).mean(axis=1)
        relative = off / np.maximum(np.mean(exact, axis=1), 1e-9)
        true = float(off.sum() / np.mean(exact, axis=1).sum())
        how = f"{checked} painted pixels, {scene.width}x{scene.height}, map {name}"
        how += f"; 95th percentile {100 * np.percentile(relative, 95):.2f} %"
        how += f"; finished behind for {seconds:.1f} s"
        title = f"painted pixels, {layers} layer{'s'[: layers - 1]}, {name}"
        yield Record.at_most(
            f"{title}: median", 100.0 * float(np.median(relative)), "%", 0.5, how=how
        )
        yield Record.at_most(f"{title}: maximum", 100.0 * float(relative.max()), "%", 3.0, how=how)
        ratio = stated / true
        met = 0.5 <= ratio <= 2.0
        said = f"stated {100 * stated:.3f} %, true {100 * true:.3f} % (target 0.5 to 2)"
        yield Record(f"{title}: stated / true error", ratio, "x", 2.0, met, how=said)


def _without(edit: EditSession) -> NDArray[np.float32]:
    """Return the frame without local layers."""
    strengths = [(layer, layer.visible) for layer in edit.layers]
    for layer, _ in strengths[1:]:
        layer.visible = False
    bare = edit.render()
    for _ in strengths[1:]:
        edit.undo()
    return bare


def _edges(edit: EditSession, name: str) -> Record:
    """Measure by how much steps of delta E between neighbours exceed what the mask explains.

    A soft stroke of colour is compared with the frames of its end points: the step between two
    pixels is explained by the difference of their weights times that of the two colours, and by the
    steps of these frames.
    """
    _painted(edit, 0)
    bare = edit.render()
    effect = Tint((0.2, 0.35, 1.0))
    edit.apply("body", effect)
    whole = edit.render()
    edit.undo()
    edit.paint(_stroke(edit, _LAYERS[0][0], 0.125), effect, where="local")
    frame, mask = edit.render(), edit.layers[-1].layer.mask
    assert isinstance(mask, Local)
    scene = edit.scene
    exposure = exposure_of(frame)

    def lab(image: NDArray[np.float32]) -> Float64:
        return cielab(np.clip(exposure * image, 0.0, 1.0))

    weight = np.full(scene.height * scene.width, np.nan)
    inside = ~scene.bordering & (scene.pixel_part == scene.parts.index("body"))
    weight[scene.pixels[inside]] = SurfaceWeights(scene).of(mask)[inside]
    weights = weight.reshape(scene.height, scene.width)
    a, b, c = lab(bare), lab(whole), lab(frame)
    worst = 0.0

    def difference(values: Float64) -> Float64:
        return np.asarray(np.sqrt((values**2).sum(axis=-1)))

    apart = difference(b - a)
    for axis in (0, 1):
        own = difference(np.diff(c, axis=axis))
        slope = np.abs(np.diff(weights, axis=axis))
        near = np.maximum(apart, np.roll(apart, -1, axis))
        near = near[:-1] if axis == 0 else near[:, :-1]
        ends = [difference(np.diff(end, axis=axis)) for end in (a, b)]
        explained = 2.0 * slope * near + np.maximum(*ends)
        known = np.isfinite(slope)
        worst = max(worst, float((own - explained)[known].max()))
    how = f"blue stroke on red, radius {0.125 * scene.height:.0f} pixels, map {name}"
    return Record.at_most("step of delta E beyond what the mask explains", worst, "", 1.0, how=how)
