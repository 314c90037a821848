"""Reports: what was measured of frames, and what they could leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from traitbrdf.session.frames import Shown, View, measured
from traitbrdf.session.preparation import timed
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.space.traits import TraitSpace
from traitbrdf.transport.transport import Transport


def view_report(
    view: View,
    transport: Transport,
    materials: Sequence[Material],
    embedding: BRDFEmbedding,
    device: torch.device,
) -> dict[str, Any]:
    """Return what `EditSession.report` says of the frame that a view shows.

    Parameters
    ----------
    view : View
    transport : Transport, of the view
    materials : sequence of Material, one for each part
    embedding : BRDFEmbedding
    device : torch.device, of frames
    """
    scene, prepared = view.scene, view.prepared
    plain = replace(materials[0], table=None, offset=None)
    promise = None if prepared is None else prepared.promise
    return {
        "promise": None if promise is None else promise.as_dict(),
        "frame_error": measured(view, transport),
        "seconds": dict(view.times),
        "prepared_from": "cache" if prepared is not None and prepared.cached else "scratch",
        "image": [scene.height, scene.width],
        "covered_pixels": int(np.count_nonzero(scene.uncovered < 1.0)),
        "fragments": len(scene.pixels),
        "basis_images": transport.rank,
        "exact_frames": view.exact_frames,
        "trained_images": {scene.parts[i]: n for i, n in view.trained.items()},
        "cells_seen": len(transport.cells),
        "cells": embedding.grid_.size,
        "bytes": transport.bytes,
        "device": str(device),
        "clipped_texels": scene.environment.clipped_texels,
        "left_out": _left_out(view, transport, plain, embedding, device),
    }


def part_report(material: Material, shown: Shown, traits: TraitSpace) -> dict[str, Any]:
    """Return what `EditSession.report` says of one part.

    Parameters
    ----------
    material : Material, of the part
    shown : Shown
    traits : TraitSpace
    """
    return {
        "material": material.name,
        "pixels": len(shown.frame.radiance),
        "error": shown.frame.error,
        "tier": shown.tier,
        "scores": traits.score(material.z),
    }


def _left_out(
    view: View,
    transport: Transport,
    plain: Material,
    embedding: BRDFEmbedding,
    device: torch.device,
) -> dict[str, Any]:
    """Return what the last frame could leave out, and what that saved."""
    scene, canvas = view.scene, view.canvas
    if canvas is None:
        return {}
    frames = [one.frame for one in view.shown]
    changed = canvas.changed
    drawn = [scene.pixels[scene.part_slice(i)] for i in changed]
    still = [i for i in range(len(scene.parts)) if i not in changed]
    return {
        "shadow_rays": {
            "parts": [
                part
                for part, casts in zip(scene.parts, scene.casts, strict=True)
                if scene.shadows and not casts
            ],
            "rays_cast": scene.rays_cast,
        },
        "cells": {
            "seen": len(transport.cells),
            "of": embedding.grid_.size,
            "seconds": timed(lambda: plain.values(embedding, transport.cells), device),
            "seconds_for_all": timed(lambda: plain.values(embedding), device),
        },
        "edits": {  # parts that nobody has edited: edits would need all basis images
            "parts": [scene.parts[i] for i in sorted(transport.fixed)],
            "basis_images": min(
                (b.rank for b in transport.bases if transport.fixed.intersection(b.parts)),
                default=0,
            ),
            "of": transport.rank,
        },
        "channels": {"computed": 1 if transport.grey else 3, "of": 3},
        "parts_not_edited": {
            "parts": [scene.parts[i] for i in still],
            "seconds_saved": sum(view.shown[i].seconds for i in still),
        },
        "pixels": {
            "redrawn": len(np.unique(np.concatenate(drawn))) if drawn else 0,
            "of": scene.height * scene.width,
            "seconds": timed(lambda: canvas.redraw(changed, frames), device),
            "seconds_for_all": timed(lambda: transport.compose(frames), device),
        },
    }
