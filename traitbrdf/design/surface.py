"""Weights of local masks at the fragments of a scene; a stroke that goes on costs what is new."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.design.masks import Brushed, Framing, Local
from traitbrdf.design.strokes import Stroke
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Hits
from traitbrdf.scene.trails import Trail, cover, trail_of

Float32 = NDArray[np.float32]

_MASKS = 16
"""Masks whose weights are kept."""


def drawn(scene: Scene, stroke: Stroke, framing: Framing) -> Trail:
    """Return the trail of a stroke that was drawn on some image of a scene.

    Parameters
    ----------
    scene : Scene
    stroke : Stroke
    framing : Framing, of the image
    """
    if framing != Framing.of(scene):
        scene = scene.changed(camera=framing.camera, size=(framing.height, framing.width))
    flow = np.full(len(stroke.points), stroke.flow)
    if stroke.pressure is not None:
        flow *= np.asarray(stroke.pressure)
    line = np.asarray(stroke.points, np.float64)
    return trail_of(scene, line, stroke.radius, stroke.units == "world", flow)


def touched(scene: Scene, stroke: Stroke, framing: Framing) -> tuple[str, ...]:
    """Return the names of the parts that a stroke runs over; none if it lies beside the object.

    Parameters
    ----------
    scene : Scene
    stroke : Stroke
    framing : Framing, of the image that it was drawn on
    """
    return tuple(scene.parts[i] for i in np.unique(drawn(scene, stroke, framing).parts))


class _Weighed(NamedTuple):
    """What some strokes come to.

    Attributes
    ----------
    strokes : tuple of Brushed
    before : (P,) weights of all but the last
    settled : (P,) what the settled samples of the last one cover
    done : int, these samples
    weight : (P,) weights of all
    """

    strokes: tuple[Brushed, ...]
    before: Float32
    settled: Float32
    done: int
    weight: Float32


Places = tuple[Float32, Float32, NDArray[np.int32]]


def points_of(hits: Hits) -> Places:
    """Return positions (n, 3), normals (n, 3) and parts (n,) of what rays hit."""
    return hits.position.astype(np.float32), hits.normal.astype(np.float32), hits.part


class SurfaceWeights:
    """Weights of local masks at points of a scene's surface.

    Parameters
    ----------
    scene : Scene
    places : (P, 3) float32, (P, 3) float32 and (P,) int32, or None
        World positions, unit normals and parts; None is those of the scene's fragments.
    """

    def __init__(self, scene: Scene, places: Places | None = None) -> None:
        self._scene = scene
        self._places = places
        self._known: list[_Weighed] = []

    @property
    def places(self) -> Places:
        """Positions, normals and parts."""
        if self._places is None:
            scene = self._scene
            middle = scene.offsets[:-1] + np.diff(scene.offsets) // 2
            self._places = (
                np.ascontiguousarray(scene.positions[middle], np.float32),
                np.ascontiguousarray(scene.normals[middle], np.float32),
                np.ascontiguousarray(scene.pixel_part, np.int32),
            )
        return self._places

    def of(self, mask: Local) -> Float32:
        """Return the weight (P,) of a mask at all points.

        Parameters
        ----------
        mask : Local
        """
        scene = self._scene
        weight = self._of(mask.strokes)
        if mask.inverted:
            weight = 1.0 - weight
        inside = np.array([part in mask.parts for part in scene.parts])
        return weight if inside.all() else weight * inside[self.places[2]]

    def amounts(self, varying: Varying) -> Float32:
        """Return the amounts (n, P) of a part's local layers: opacity times weight.

        Parameters
        ----------
        varying : Varying
        """
        amounts = np.empty((len(varying.local), len(self.places[2])), np.float32)
        for amount, layer in zip(amounts, varying.local, strict=True):
            if isinstance(layer.mask, Local):
                np.multiply(self.of(layer.mask), np.float32(layer.strength), out=amount)
        return amounts

    def _of(self, strokes: tuple[Brushed, ...]) -> Float32:
        if not strokes:
            return np.zeros(len(self.places[2]), np.float32)
        kept, grown = 0, None
        base: _Weighed | None = None
        for known in self._known:
            count = len(known.strokes)
            if count > len(strokes) or not _same(known.strokes[:-1], strokes[: count - 1]):
                continue
            if known.strokes[-1] is strokes[count - 1]:
                if count > kept:
                    kept, base = count, known
            elif count == len(strokes) and _continues(known.strokes[-1], strokes[-1]):
                grown = known
        if base is None or kept < len(strokes):
            weight = np.zeros(len(self.places[2]), np.float32)
            if grown is not None:
                kept, base, weight = len(strokes) - 1, None, grown.before
            elif base is not None:
                weight = base.weight
            for i in range(kept, len(strokes)):
                base = self._added(strokes[: i + 1], weight, grown)
                grown, weight = None, base.weight
        assert base is not None
        self._known = [base, *(one for one in self._known if one is not base)][:_MASKS]
        return base.weight

    def _added(
        self, strokes: tuple[Brushed, ...], before: Float32, grown: _Weighed | None
    ) -> _Weighed:
        """Add the last of some strokes, which may continue a known one."""
        one, scene = strokes[-1], self._scene
        trail = drawn(scene, one.stroke, one.framing)
        settled, known = np.zeros_like(before), 0
        if grown is not None:
            settled, known = grown.settled, grown.done
            self._known.remove(grown)  # it is used up
        hardness = one.stroke.hardness
        cover(settled, self.places, trail.until(trail.settled), hardness, one.across, known)
        whole = settled.copy()
        cover(whole, self.places, trail, hardness, one.across, trail.settled)
        weight = before * (1.0 - whole) if one.erase else np.maximum(before, whole)
        return _Weighed(strokes, before, settled, trail.settled, weight)


def _same(some: Sequence[Brushed], others: Sequence[Brushed]) -> bool:
    return all(one is other for one, other in zip(some, others, strict=True))


def _continues(old: Brushed, new: Brushed) -> bool:
    """Return whether a stroke goes on where another ended."""
    a, b = old.stroke, new.stroke
    count = len(a.points)
    if (a.pressure is None) != (b.pressure is None):
        return False
    pressed = a.pressure is not None and b.pressure is not None
    if pressed and b.pressure[:count] != a.pressure:  # type: ignore[index]
        return False
    return (
        (a.radius, a.hardness, a.flow, a.units) == (b.radius, b.hardness, b.flow, b.units)
        and (old.framing, old.erase, old.across) == (new.framing, new.erase, new.across)
        and b.points[:count] == a.points
    )
