"""Frames of a prepared view: by the basis where it is trusted, exactly elsewhere."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.session.canvas import Canvas
from traitbrdf.session.frames import Shown, View
from traitbrdf.session.local import LocalFrames
from traitbrdf.session.preparation import TURNS, trusted_error
from traitbrdf.session.settings import Settings
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.transport.basis import Basis, PartFrame
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]

TRAINED_IMAGES = 8
"""At most this many exact images are added to a basis."""


class Exact(NamedTuple):
    """A part rendered without the basis, and what later frames may use of it.

    Attributes
    ----------
    frame : PartFrame
    floor : float
        Error that exact frames of the part have, where it is above what is trusted; else 0.
    trained : Transport or None
        The transport with its image added to the basis, if that may help.
    budget : int
        Images that may still be added to the basis then.
    known : list
        The bases that it was trained from.
    """

    frame: PartFrame
    floor: float
    trained: Transport | None
    budget: int
    known: list[Basis]


@dataclass(frozen=True)
class Renderer:
    """Makes frames as exact as was asked for.

    Parameters
    ----------
    embedding : BRDFEmbedding
        Decodes materials.
    settings : Settings
    """

    embedding: BRDFEmbedding
    settings: Settings

    def frame(
        self,
        view: View,
        transport: Transport,
        materials: Sequence[Material],
        exact: bool = True,
        varying: Mapping[str, Varying] | None = None,
    ) -> Float32:
        """Return the frame (H, W, 3) of a prepared view; what is shown is kept with the view.

        Parameters
        ----------
        view : View
        transport : Transport, of the view
        materials : sequence of Material, one for each part
        exact : bool
            Whether parts that the basis shows too inexactly are rendered without it.
        varying : mapping of part to Varying, or None
            Parts that are painted locally.
        """
        start = time.perf_counter()
        tables: dict[Material, torch.Tensor] = {}
        wanted = Counter(m for i, m in enumerate(materials) if (i, m) not in view.kept)
        shown = [
            self._shade(view, transport, i, material, tables, wanted[material] == 1, exact)
            for i, material in enumerate(materials)
        ]
        if view.local is not None:
            view.local.begin(exact)
        for part, one in (varying or {}).items():
            index = view.scene.parts.index(part)
            shown[index] = self._painted(view, transport, index, shown[index], one, exact)
        if view.canvas is None:
            view.canvas = Canvas(transport)
        view.canvas.draw([one.frame for one in shown])
        view.shown = shown
        image = view.canvas.image()
        view.times["frame"] = time.perf_counter() - start
        return image

    def _shade(
        self,
        view: View,
        transport: Transport,
        index: int,
        material: Material,
        tables: dict[Material, torch.Tensor],
        alone: bool,
        exact: bool,
    ) -> Shown:
        """Shade one part.

        `tables` holds what was decoded for this frame; `alone` says that no other part needs the
        same material.
        """
        known = view.kept.get((index, material))
        if known is not None and not (
            exact and known.tier != "exact" and known.frame.error > self.allowed(view, index)
        ):
            view.kept.move_to_end((index, material))
            return known
        start = time.perf_counter()
        if material not in tables:
            values = material.values(self.embedding, transport.cells)
            tables[material] = torch.from_numpy(values).to(self.settings.place)
        frame = transport.shade(index, tables[material], self._mirror(material), alone)
        tier: Literal["basis", "trained", "exact"] = "basis"
        part = transport.parts[index]
        if part is not None and part.group in view.budget:
            tier = "trained"
        if exact and frame.error > self.allowed(view, index):
            frame, tier = self._exactly(view, transport, index, material), "exact"
            tables.clear()  # the transport may see other cells by now
        shown = Shown(frame, tier, time.perf_counter() - start)
        view.keep(index, material, shown)
        return shown

    def _painted(
        self,
        view: View,
        transport: Transport,
        index: int,
        base: Shown,
        varying: Varying,
        exact: bool,
    ) -> Shown:
        """Shade a part that is painted locally, over what it is elsewhere."""
        start = time.perf_counter()
        tier: Literal["basis", "trained", "exact"] = base.tier
        while True:
            known = view.local
            if known is None or not known.current or known.transport is not transport:
                known = view.local = LocalFrames(transport, self.embedding, view.surface())
                known.begin(exact)
            frame = known.frame(index, base.frame, varying, exact)
            if frame.error <= self.allowed(view, index):
                worst = None
                break
            # an exact image of what is shown worst makes the basis show it better
            worst = known.worst(index, varying)
            if not exact or not view.untried(index, worst):
                break
            view.tried.add((index, worst))
            self._exactly(view, transport, index, worst)
            tier = "trained"
        seconds = base.seconds + time.perf_counter() - start
        return Shown(frame, tier, seconds, worst)

    def _mirror(self, material: Material) -> torch.Tensor | None:
        """Return a material's weight (3,) of a perfect mirror; None where it has none."""
        if not material.mirror.any():
            return None
        return torch.from_numpy(material.mirror.astype(np.float32)).to(self.settings.place)

    def allowed(self, view: View, index: int, floor: float | None = None) -> float:
        """Return the measured error up to which a part is shown by the basis.

        Parameters
        ----------
        view : View
        index : int
            Index of the part.
        floor : float or None
            Error of the part's exact frames; None is what the view knows of it.
        """
        if self.settings.quality == "reference":
            return -1.0
        if self.settings.fps is not None:
            return math.inf
        # exact frames gain nothing where they err as much
        allowed = trusted_error(view.scene, index, self.settings.error)
        least = view.floor.get(index, 0.0) if floor is None else floor
        return max(allowed, least) if self.settings.error is None else allowed

    def _exactly(
        self, view: View, transport: Transport, index: int, material: Material
    ) -> PartFrame:
        """Render a part without the basis, and add its image to the basis for later edits."""
        with TURNS.urgent():
            found = self.exact(view, transport, index, material)
        self.take(view, transport, index, found)
        return found.frame

    def exact(
        self,
        view: View,
        transport: Transport,
        index: int,
        material: Material,
        progress: Progress | None = None,
    ) -> Exact:
        """Render a part without the basis, and extend a copy of the basis; nothing is changed.

        Parameters
        ----------
        view : View
        transport : Transport, of the view
        index : int
            Index of the part.
        material : Material
        progress : called with (stage, fraction done); may raise to cancel
        """
        values = material.values(self.embedding)
        part, known = transport.parts[index], transport.bases
        frame = transport.shade_exactly(index, values, progress=progress)
        floor = view.floor.get(index, 0.0)
        if frame.error > trusted_error(view.scene, index):
            floor = max(floor, 1.2 * frame.error)
        allowed = self.allowed(view, index, floor)
        budget = 0 if part is None else view.budget.get(part.group, TRAINED_IMAGES)
        trained = None
        # if even the exact frame misses the error asked for, the basis cannot meet it
        if part is not None and budget > 0 and frame.error <= allowed:
            trained = transport.trained(index, frame.radiance)
            table = torch.from_numpy(values[trained.cells]).to(self.settings.place)
            met = trained.shade(index, table).error <= allowed
            # every image makes all frames slower: take few that do not help
            budget -= 1 if met else TRAINED_IMAGES // 2
        mirror = self._mirror(material)
        if mirror is not None and part is not None:
            frame = replace(frame, radiance=frame.radiance + mirror * part.mirror)
        return Exact(frame, floor, trained, budget, known)

    def take(self, view: View, transport: Transport, index: int, found: Exact) -> None:
        """Let the view's later frames use what `exact` found; the caller holds the view's lock.

        Parameters
        ----------
        view : View
        transport : Transport, of the view
        index : int
            Index of the part.
        found : Exact
        """
        view.exact_frames += 1
        if found.floor > 0.0:
            view.floor[index] = found.floor
        part = transport.parts[index]
        # another image may have been added meanwhile: then this one is not
        if found.trained is not None and part is not None and transport.bases is found.known:
            transport.adopt(found.trained)
            view.trained[index] = view.trained.get(index, 0) + 1
            view.budget[part.group] = found.budget
