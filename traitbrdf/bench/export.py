"""Exported materials: how far the models of other programs are from the tables."""

from __future__ import annotations

import functools
import importlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.bench.datasets import maps
from traitbrdf.bench.records import Record, Say
from traitbrdf.export.fitting import Fit, Target, fit
from traitbrdf.export.gltf import GltfTarget
from traitbrdf.export.lobes import PicturePixels, Pixels, fitting_pixels
from traitbrdf.export.openpbr import OpenPBRTarget
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.space.library import default_library

Float32 = NDArray[np.float32]

_SIDE = 40  # pixels of a sphere
_FEWER = 30  # materials under further maps, and of the further target
_MAPS = ("studio", "forest")
_BAD = 0.3  # FLIP that a line tells of


def exported(data: Path | None, quick: bool, say: Say) -> Iterator[Record]:
    """Fit library materials to glTF and OpenPBR, and compare pictures of spheres.

    Parameters
    ----------
    data, quick, say
        As for `traitbrdf.bench.run.Bench`.
    """
    library = default_library()
    grid = library.embedding.grid_
    chosen = np.random.default_rng(0).choice(library.names, 6 if quick else 100, replace=False)
    some = {name: one for name, one in maps(data, quick) if name in _MAPS}
    some = {"sky": EnvironmentMap.sky(), **some}
    pixels = fitting_pixels(grid)
    pictures = {name: PicturePixels(grid, one, _SIDE) for name, one in some.items()}
    targets: dict[str, tuple[Target[Any], int]] = {
        "glTF": (GltfTarget(), len(chosen)), "OpenPBR": (OpenPBRTarget(), min(len(chosen), _FEWER)),
    }  # fmt: skip
    for kind, (target, count) in targets.items():
        errors, seconds = [], []
        flips: dict[str, list[float]] = {name: [] for name in pictures}
        for done, material in enumerate(chosen[:count].tolist()):
            table = library[material]
            values, mirror = table.values.reshape(-1, 3), np.asarray(table.mirror, np.float64)
            start = time.perf_counter()
            found: Fit[Any] = fit(target, pixels, pixels.of_table(values, mirror))
            seconds.append(time.perf_counter() - start)
            errors.append(100.0 * found.error)
            for name, picture in pictures.items():
                if name != "sky" and done >= _FEWER:
                    continue
                ours = picture.picture(
                    functools.partial(Pixels.of_table, values=values, mirror=mirror)
                )
                theirs = picture.picture(functools.partial(target.image, found.look))
                flips[name].append(_flip(ours, theirs))
                if flips[name][-1] > _BAD:
                    say(f"  {kind}: {material} under {name}: FLIP {flips[name][-1]:.2f}")
        for name, all_of in flips.items():
            late = f"95th percentile {np.percentile(all_of, 95):.3f}, most {max(all_of):.3f}"
            how = f"{len(all_of)} library materials, spheres of {_SIDE} pixels"
            yield Record.at_most(
                f"{kind}: FLIP of the fit against the table, {name}, median",
                float(np.median(all_of)), "", 0.1, how=f"{how}; {late}",
            )  # fmt: skip
        late = f"95th percentile {np.percentile(errors, 95):.1f} %, most {max(errors):.1f} %"
        yield Record(
            f"{kind}: error under lights that the fit did not see, median",
            float(np.median(errors)), "%", how=f"{count} library materials; {late}",
        )  # fmt: skip
        yield Record(f"{kind}: time of a fit, median", float(np.median(seconds)), "s", how=how)


def _flip(ours: Float32, theirs: Float32) -> float:
    """Return the mean FLIP of two pictures on the sphere alone, both exposed alike."""
    try:
        flip = importlib.import_module("flip_evaluator")
    except ImportError as error:
        raise RuntimeError("needs FLIP: pip install flip-evaluator") from error
    lit = ours.any(axis=-1)
    exposure = exposure_of(ours[lit][None])
    shown = [(tone_map(one, exposure) / 255.0).astype(np.float32) for one in (ours, theirs)]
    errors = np.asarray(flip.evaluate(shown[0], shown[1], "LDR", applyMagma=False)[0])
    return float(errors.squeeze()[lit].mean())
