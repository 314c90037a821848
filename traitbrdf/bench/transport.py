"""Errors of frames: on unseen BRDFs, on families left out of training, and in shadows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf import reference
from traitbrdf.bench.datasets import LEFT_OUT, channels, maps, training_set, unseen
from traitbrdf.bench.oracle import Oracle, draw_fragments, relative_errors, shown_errors
from traitbrdf.bench.records import Record, Say
from traitbrdf.pictures import own_colours
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap, texel_moments
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.budget import QUALITIES, TRUSTED
from traitbrdf.session.preparation import EXACT_ABOVE
from traitbrdf.space.library import default_library
from traitbrdf.transport.basis import Training
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.transport import Transport

Float64 = NDArray[np.float64]

BENCH_CAMERA = Camera.orbit(-55.0, 30.0, zoom=1.24)
"""The teapot covers 40 % of a square frame, without the ground."""

WIDE_CAMERA = Camera.orbit(-55.0, 30.0, zoom=1.65)
"""The teapot covers 40 % of a frame of 16:9; its foot is cut off."""


def bench_scene(environment: EnvironmentMap, size: int | tuple[int, int], **more: Any) -> Scene:
    """Return the teapot on the ground.

    Parameters
    ----------
    environment : EnvironmentMap
    size : int or (height, width)
    **more
        Other settings of `Scene`.
    """
    return Scene(teapot(), environment, camera=BENCH_CAMERA, size=size, ground=True, **more)


def how_much(transport: Transport) -> str:
    """Return a description of a frame: pixels, rank r of the basis, and bytes.

    Parameters
    ----------
    transport : Transport
    """
    scene = transport.scene
    covered = int(np.count_nonzero(scene.uncovered < 1.0))
    return (
        f"{scene.width}x{scene.height}, {covered} covered pixels "
        f"({100 * (1.0 - scene.uncovered.mean()):.0f} %, the object {100 * scene.coverage:.1f} %), "
        f"r = {transport.rank}, {transport.bytes / 1e6:.0f} MB"
    )


def transport_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure transport error on unseen BRDFs: compressed frames against the oracle.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, count = (48, 16) if quick else (512, 120)
    library = default_library()
    grid = library.embedding.grid_
    training = training_set(library, quick)
    kinds = unseen(data, quick)
    tables = list(itertools.chain.from_iterable(kinds.values()))
    kind_of = np.array([name for name, members in kinds.items() for _ in members])
    lambert = next(i for i, t in enumerate(tables) if t.name.startswith("Lambert"))
    rank, resolution = QUALITIES["interactive"]
    alone, shown, psnrs, own, exact, stated = [], [], [], [], [], []
    used = 0
    rng = np.random.default_rng(1)
    with Oracle(tables) as oracle:
        for name, environment in maps(data, quick):
            scene = bench_scene(environment, size)
            transport = Transport(scene, grid, training, rank=rank, resolution=resolution)
            index, true, oracles = draw_fragments(
                oracle, scene, np.arange(len(scene.pixels)), count, rng
            )
            used += len(index)
            seen = shown_errors(transport, tables, index)
            alone.append(relative_errors(seen.basis, true))
            shown.append(relative_errors(seen.final, true))
            psnrs.append(
                [
                    reference.tone_mapped_psnr(seen.final[None, :, b], true[None, :, b])
                    for b in range(len(tables))
                ]
            )
            own.append(oracles.mean() / true.mean())
            area = np.bincount(scene.pixel_part, minlength=len(scene.parts)) / len(scene.pixels)
            exact.append(area @ seen.refused)
            stated.append(area @ seen.measured)
            say(
                f"  {name:10s} {_spread(shown[-1])}  Lambert {100 * shown[-1][lambert]:.4f} %  "
                f"PSNR 5th percentile {np.quantile(psnrs[-1], 0.05):.1f} dB; the basis alone "
                f"{_spread(alone[-1])}, of which {100 * exact[-1].mean():.1f} % were refused"
            )
    final, basis, picture = np.stack(shown), np.stack(alone), np.array(psnrs)
    refused = float(np.mean(exact))
    how = (
        f"teapot on the ground with shadows, {size}x{size}, {used / len(final):.0f} fragments a "
        f"map, {len(final)} maps, {len(tables)} BRDFs ("
        + ", ".join(f"{len(members)} {kind}" for kind, members in kinds.items())
        + f"), r = {rank}, {transport.bytes / 1e6:.0f} MB; oracle's own error "
        f"{100 * np.mean(own):.3f} %"
    )
    for kind in kinds:
        mine = kind_of == kind
        say(
            f"  {kind:17s} {_spread(final[:, mine])}; the basis alone {_spread(basis[:, mine])}, "
            f"of which {100 * np.mean(np.array(exact)[:, mine]):.1f} % were refused"
        )
    worst = np.unravel_index(np.argmax(final), final.shape)
    say(f"  worst: {tables[worst[1]].name} under map {worst[0] + 1}")
    ratio = np.array(stated) / np.maximum(basis, 1e-12)
    say(
        f"  stated / true error of the basis: median {np.median(ratio):.2f}, 5th to 95th "
        f"percentile {np.quantile(ratio, 0.05):.2f} to {np.quantile(ratio, 0.95):.2f}"
    )
    percent = 100.0 * final
    as_shown = f"basis where trusted, else exact ({100 * refused:.1f} % of the fragments); {how}"
    yield Record.at_most(
        "transport error, median", float(np.median(percent)), "%", 0.3, how=as_shown
    )
    yield Record.at_most(
        "transport error, 95th percentile", float(np.quantile(percent, 0.95)), "%", 1.0,
        how=as_shown,
    )  # fmt: skip
    yield Record.at_most("transport error, maximum", float(percent.max()), "%", 5.0, how=as_shown)
    yield Record.at_least(
        "tone-mapped PSNR, 5th percentile", float(np.quantile(picture, 0.05)), "dB", 45.0,
        how=as_shown,
    )  # fmt: skip
    yield Record("tone-mapped PSNR, median", float(np.median(picture)), "dB", how=as_shown)
    for name, value in (
        ("median", np.median(basis)),
        ("95th percentile", np.quantile(basis, 0.95)),
        ("maximum", basis.max()),
    ):
        yield Record(f"basis alone, {name}", 100.0 * float(value), "%", how=how)
    yield Record.at_most(
        "transport error, Lambert, worst map", 100.0 * float(basis[:, lambert].max()), "%", 0.1,
        how=how,
    )  # fmt: skip


def _spread(errors: Float64) -> str:
    percent = 100.0 * np.asarray(errors)
    return (
        f"median {np.median(percent):.3f} %  95th {np.quantile(percent, 0.95):.2f} %  "
        f"max {percent.max():.2f} %"
    )


def family_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Check families left out of training: are errors noticed, and what is shown then.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, count, members = (40, 24, 4) if quick else (512, 240, 12)
    library = default_library()
    grid = library.embedding.grid_
    families = LEFT_OUT[:1] if quick else LEFT_OUT
    own = {
        family: [library[n] for n, f in zip(library.names, library.families, strict=True)
                 if f == family][:members]
        for family in families
    }  # fmt: skip
    tables = list(itertools.chain.from_iterable(own.values()))
    rank, resolution = QUALITIES["interactive"]
    truly, found, after = [], [], []
    rng = np.random.default_rng(5)
    with Oracle(tables) as oracle:
        for name, environment in maps(data, quick)[:: 1 if data is None else 5]:
            scene = bench_scene(environment, size)
            # the whole shape has one material; the error is that of its whole frame
            parts = len(scene.shape.parts)
            own_fragments = np.arange(scene.part_slice(parts - 1).stop)
            area = np.bincount(scene.pixel_part[own_fragments], minlength=parts)
            area = area / area.sum()
            index, true, _ = draw_fragments(oracle, scene, own_fragments, count, rng)
            start = 0
            for family, mine in own.items():
                others = [
                    library.embedding.decode_values(z)
                    for z, f in zip(library.coordinates, library.families, strict=True)
                    if f != family
                ][:: 6 if quick else 1]
                # train without analytic models too: some of them make up the family
                channels = np.concatenate(others, axis=1)
                training = Training(channels, np.ones(channels.shape[1]))
                transport = Transport(scene, grid, training, rank=rank, resolution=resolution)
                seen = shown_errors(transport, mine, index)
                target = true[:, start : start + len(mine)]
                start += len(mine)
                truly.append(relative_errors(seen.basis, target))
                after.append(relative_errors(seen.final, target))
                found.append(area @ seen.measured[:parts] > TRUSTED * EXACT_ABOVE)
                wrong = truly[-1] > EXACT_ABOVE
                say(
                    f"  {name:10s} {family:15s} basis {_spread(truly[-1])}; {wrong.sum()} above "
                    f"1 %, {found[-1][wrong].sum()} of them noticed; then {_spread(after[-1])}"
                )
    wrong = np.concatenate(truly) > EXACT_ABOVE
    refused, shown = np.concatenate(found), np.concatenate(after)
    how = (
        f"{', '.join(families)} left out in turn, and all closed forms; teapot on the ground with "
        f"shadows, {size}x{size}, r = {rank}; a case is a BRDF on the whole shape under a map, "
        f"{len(wrong)} of them, {count} fragments each"
    )
    yield Record("left out: cases with an error above 1 %", float(wrong.sum()), "", how=how)
    if wrong.any():
        yield Record.at_least(
            "left out: of these noticed", 100.0 * float(refused[wrong].mean()), "%", 100.0, how=how
        )
        noticed = wrong & refused
        if noticed.any():
            yield Record(
                "left out: error of these as shown, median",
                100.0 * float(np.median(shown[noticed])), "%", how=how,
            )  # fmt: skip
            yield Record.at_most(
                "left out: error of these as shown, maximum",
                100.0 * float(shown[noticed].max()), "%", 1.0, how=how,
            )  # fmt: skip
    yield Record(
        "left out: error of all as shown, 95th percentile",
        100.0 * float(np.quantile(shown, 0.95)), "%", how=how,
    )  # fmt: skip


# -- shadows --------------------------------------------------------------------------------------


def shadow_error(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Measure shadows: the operator against the oracle, and a small sun's shadow against rays.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    size, count = (64, 16) if quick else (128, 150)
    library = default_library()
    grid = library.embedding.grid_
    tables = [library[name] for name in library.names[1 :: 80 if quick else 20]]
    grey = np.full((grid.size, 1), 1.0 / math.pi, np.float32)
    _, resolution = QUALITIES["interactive"]
    rng = np.random.default_rng(6)
    errors = []
    with Oracle(tables) as oracle:
        for name, environment in [
            *maps(data, quick),
            ("sky, 64 rows", EnvironmentMap.sky(rows=64)),
        ]:
            scene = bench_scene(environment, size)
            ground = scene.parts.index("ground")
            span = scene.part_slice(ground)
            operator = Operator(scene, grid, resolution)
            lit = operator.part_images(ground, grey)[:, 1, 0]
            free = Operator(scene.changed(shadows=False), grid, resolution)
            unhidden = free.part_images(ground, grey)[:, 1, 0]
            dark = np.flatnonzero(lit < 0.9 * unhidden)
            index, true, _ = draw_fragments(oracle, scene, dark + span.start, count, rng)
            images = operator.part_images(ground, channels(tables))[index - span.start]
            errors.append(relative_errors(own_colours(images), true))
            say(f"  {name:12s} {_spread(errors[-1])}")
    percent = 100.0 * np.stack(errors)
    how = (
        f"teapot on the ground, {size}x{size}, {count} ground fragments that lose a tenth of "
        f"their light or more, {len(tables)} library tables, {len(errors)} maps, uncompressed"
    )
    yield Record.at_most("error in the shade, median", float(np.median(percent)), "%", 1.0, how=how)
    yield Record("error in the shade, maximum", float(percent.max()), "%", how=how)
    right = total = 0
    # suns so small that their shadows have hardly any penumbra
    suns = [(0.28, 0.33, 512), (0.2, 0.6, 256), (0.35, 0.9, 256), (0.15, 0.1, 512)]
    for v, u, rows in suns[: 1 if quick else None]:
        row, column = int(v * rows), int(u * 2 * rows)
        image = np.full((rows, 2 * rows, 3), 1e-3)
        image[row, column] = 1e4
        scene = bench_scene(EnvironmentMap(image), size)
        agree, fragments = _sharp_shadows(scene, (row, column), Operator(scene, grid, resolution))
        say(f"  sun in one texel of {rows} x {2 * rows}: {agree} of {fragments} fragments right")
        right, total = right + agree, total + fragments
    yield Record.at_least(
        "a one-texel sun: lit or dark as a ray says", 100.0 * right / total, "%", 100.0,
        how=f"{total} fragments of all parts, {size}x{size}, interpolated as in frames",
    )  # fmt: skip


def _sharp_shadows(scene: Scene, texel: tuple[int, int], operator: Operator) -> tuple[int, int]:
    """Return how many fragments agree with a ray towards the one bright texel, and of how many.

    Only fragments of one sample count whose light does not graze the surface.
    """
    moment = texel_moments(scene.environment)[texel]
    omega = float(np.linalg.norm(moment))
    toward = moment / omega
    grey = np.full((operator.grid.size, 1), 1.0 / math.pi, np.float32)
    full = float(scene.environment.image[texel][1]) * omega / math.pi
    right = total = 0
    for part in range(len(scene.parts)):
        span = scene.part_slice(part)
        index = np.arange(span.start, span.stop)[~scene.bordering[span]]
        sample = scene.offsets[index]
        cos = scene.normals[sample] @ toward
        keep = cos > 0.15
        index, sample, cos = index[keep], sample[keep], cos[keep]
        free = scene.visible(sample, np.broadcast_to(toward, (len(sample), 3)))
        shown = operator.part_images(part, grey)[index - span.start, 1, 0] / (full * cos)
        right += int(np.count_nonzero((shown > 0.5) == free))
        total += len(index)
    return right, total
