"""Frames of parts that are painted locally, so that their material differs from pixel to pixel.

The frame of a part is Q (C f), linear in the table f, but f is not linear in the
weights of the layers. `LocalFrames` knows C f at a few weights of each layer, the knots, where
effects are applied as for whole parts. Between them it is interpolated by cubic polynomials, in as
many dimensions as layers have their rims at a fragment. How many knots a layer needs is measured at
points between them. Where the rims of several layers cross there would be very many: frames of a
stroke that is being painted make do with fewer there, and the finished frame has more.

The basis shows dark pixels of sharp lobes less exactly than others. `corrections` are what exact
images of some materials (each layer there wholly, by half, or not at all) differ by from those of
the basis. Between these they are interpolated. They take seconds, and come behind.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.scene.scene import Scene
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.transport.basis import PartFrame
from traitbrdf.transport.blends import Blend, Shares
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

FINEST = 32
"""Most steps between knots of a layer, at which effects are applied."""

FEWEST = 4
"""Fewest steps of a layer that is not measured, or that lies below others whose rims cross it."""

_ROOT = 3
"""Knots of layers below others are uniform in this root of the weight, of which mixtures are cubic
polynomials: what a move on top does may change within the first hundredths of the weight."""

MOST_KNOTS = (27, 320)
"""Most knots where rims of several layers cross: in live frames, and in finished ones."""

_STRAIGHT = 1e-4
"""The same up to which the ends of a layer alone will do: mixtures are straight."""

FRESH_KNOTS = 1
"""Most knots that are computed for a live frame, beside those without which there is no frame."""

_SMOOTH = 2e-3
"""Relative error of responses halfway between knots from which there are more knots."""

DOUBTED = 2.5e-3
"""Measured error of a material from which the basis is corrected where it is painted."""

_HALVES = 2
"""Steps along each layer between materials whose exact images correct the basis."""

_NEAR = 0.1  # weights by which a corner may be off the knot that tells its error

_CORNERS = 8  # materials whose exact images are computed together

_KNOWN = 1 << 27
"""Bytes of responses that are kept, by material."""

_PIECE = 1024  # fragments whose exact images are computed between two reports
_ENTRIES = 1 << 15  # terms of sums over knots at a time; what they need fits the cache


def lagrange(place: NDArray[np.float64], steps: int) -> tuple[Int64, NDArray[np.float64]]:
    """Return the knots that places are interpolated from, and their weights, both (m, 2 to 4).

    Polynomials are cubic, or of a lower degree where there are fewer than four knots.

    Parameters
    ----------
    place : (m,) float64
        In units of the distance between knots, from 0 to `steps`.
    steps : int
        Number of knots less one.
    """
    order = min(steps, 3)
    first = np.clip(np.floor(place).astype(np.int64) - 1, 0, steps - order)
    t, points = (place - first)[:, None], np.arange(order + 1)
    weights = np.ones((len(place), order + 1))
    for i in points:
        for j in points[points != i]:
            weights[:, i : i + 1] *= (t - j) / (i - j)
    return first[:, None] + points, weights


def fewer(steps: Sequence[int], most: int) -> list[int]:
    """Return steps along some axes, halved where they are most until there are few enough knots.

    Parameters
    ----------
    steps : sequence of int
        Powers of two.
    most : int
        Greatest number of knots; both ends of each axis always remain.
    """
    found = list(steps)
    while math.prod(s + 1 for s in found) > most and max(found) > 1:
        found[found.index(max(found))] //= 2
    return found


_Axis: TypeAlias = tuple[int, bool]
"""A layer's place among the local ones, and whether others are above it at some fragments."""


@dataclass(eq=False)
class _Paint:
    """What is known of one part's layers under one basis.

    Attributes
    ----------
    varying : Varying, which keeps alive what it is known by
    scale : amount of each local layer at its last knot
    steps : dict, knots less one that a layer needs, by its axis and whether it is below others
    corrections : dict, (P, 3) by amounts in units of scale / _HALVES
        What exact images differ by from those of the basis; NaN where that is not known.
    place : dict, row of `values` by knot (see `amounts`)
    values : (n, 3 r + 5) tensor or None
        Coefficients, mirror, deviation and level at each of the knots; there is room for more.
    """

    varying: Varying
    scale: tuple[float, ...]
    steps: dict[_Axis, int] = field(default_factory=dict)
    corrections: dict[tuple[int, ...], Float32] = field(default_factory=dict)
    place: dict[tuple[int, ...], int] = field(default_factory=dict)
    values: torch.Tensor | None = None

    def amounts(self, key: Sequence[int]) -> list[float]:
        """Return the amount of each layer at a knot.

        It is i / FINEST of the layer's scale for i to FINEST, and ((i - FINEST) / FINEST)^_ROOT of
        it above that.
        """
        shares = [i / FINEST if i <= FINEST else (i / FINEST - 1.0) ** _ROOT for i in key]
        return [scale * share for scale, share in zip(self.scale, shares, strict=True)]

    def groups(self, amounts: Float32) -> Iterator[tuple[Int64, list[_Axis], Float32]]:
        """Divide fragments with amounts (n, m) by the layers whose rims they are at.

        Yields, for each group, its fragments, the layers with rims there, and where these are
        between their first and their last knot (n, m): in [0, 1], roots for layers below others.
        """
        places = amounts / np.array(self.scale, np.float32)[:, None]
        rims = (places > 0.0) & (places < 1.0)
        above = np.zeros_like(rims)
        above[:-1] = np.logical_or.accumulate(amounts[:0:-1] > 0.0, axis=0)[::-1]
        lower = rims & above
        places[lower] **= np.float32(1.0 / _ROOT)
        patterns, code = _patterns(np.concatenate([rims, lower]))
        for one, pattern in enumerate(patterns):
            at = np.flatnonzero(code == one)
            rim, root = np.split(pattern, 2)
            yield at, [(int(k), bool(root[k])) for k in np.flatnonzero(rim)], places[:, at]

    def add(self, keys: Sequence[tuple[int, ...]], values: torch.Tensor) -> None:
        """Add rows."""
        known = len(self.place)
        if self.values is None:
            self.values = values.new_empty((max(64, len(keys)), values.shape[1]))
        while known + len(keys) > len(self.values):
            self.values = torch.cat([self.values, torch.empty_like(self.values)])
        self.values[known : known + len(keys)] = values
        self.place.update((key, known + i) for i, key in enumerate(keys))


@dataclass(frozen=True, eq=False)
class _Stencil:
    """Which knots fragments are interpolated from.

    Attributes
    ----------
    keys : sequence of tuples
        The knots that are used; see `_Paint.amounts`.
    knot : (m, s) int64
        The knots of each fragment among these.
    weight : (m, s) float32
    """

    keys: list[tuple[int, ...]]
    knot: Int64
    weight: Float32

    @classmethod
    def of(cls, places: Float32, layers: Sequence[_Axis], steps: Sequence[int]) -> _Stencil:
        """Find the knots of places (n, m) that differ along some axes.

        Other layers are there wholly or not at all, which need not be the same everywhere.
        """
        count, axes = places.shape[1], [axis for axis, _ in layers]
        fixed = np.delete(np.arange(len(places)), axes)
        whole, group = _patterns(places[fixed] > 0.0)
        code, weight = group[:, None], np.ones((count, 1), np.float32)
        for axis, step in zip(axes, steps, strict=True):
            at, share = lagrange(places[axis].astype(np.float64) * step, step)
            code = (code[:, :, None] * (step + 1) + at[:, None, :]).reshape(count, -1)
            weight = (weight[:, :, None] * share[:, None, :].astype(np.float32)).reshape(count, -1)
        size = math.prod(step + 1 for step in steps)
        used = np.flatnonzero(np.bincount(code.ravel(), minlength=len(whole) * size))
        keys = np.empty((len(used), len(places)), np.int64)
        keys[:, fixed] = FINEST * whole[used // size]
        rest = used % size
        for layer, step in zip(layers[::-1], steps[::-1], strict=True):
            keys[:, layer[0]] = _knots(rest % (step + 1) * (FINEST // step), layer)
            rest = rest // (step + 1)
        place = np.zeros(len(whole) * size, np.int64)
        place[used] = np.arange(len(used))
        return cls([tuple(key) for key in keys.tolist()], place[code], weight)

    def sums(self, paint: _Paint, rows: Int64, some: slice) -> torch.Tensor:
        """Return the responses of some fragments, given the rows of the knots."""
        values = paint.values
        assert values is not None
        return torch.nn.functional.embedding_bag(
            torch.from_numpy(rows[self.knot[some]]).to(values.device), values, mode="sum",
            per_sample_weights=torch.from_numpy(self.weight[some]).to(values.device),
        )  # fmt: skip


@dataclass(eq=False)
class _PartState:
    """What was shown of a part last."""

    paint: _Paint
    base: PartFrame
    amounts: Float32
    frame: PartFrame
    errors: Float32  # (P, 2) deviation and level
    rough: NDArray[np.bool_]  # (P,) whether a finished frame has more knots there


class LocalFrames:
    """Frames of locally painted parts of one prepared view.

    Parameters
    ----------
    transport : Transport
    embedding : BRDFEmbedding
    weights : SurfaceWeights, of the scene
    """

    def __init__(
        self, transport: Transport, embedding: BRDFEmbedding, weights: SurfaceWeights
    ) -> None:
        self.transport, self.embedding, self.weights = transport, embedding, weights
        self._bases = transport.bases
        self._paints: OrderedDict[Any, _Paint] = OrderedDict()
        self._states: dict[int, _PartState] = {}
        self._responses: OrderedDict[tuple[int, Material], torch.Tensor] = OrderedDict()
        self._bytes = 0
        self._left = math.inf

    @property
    def current(self) -> bool:
        """Whether the transport's bases are those that responses were computed with."""
        return self._bases is self.transport.bases

    def begin(self, finished: bool) -> None:
        """Begin a frame: a live one computes few fresh knots."""
        self._left = math.inf if finished else FRESH_KNOTS

    def amounts(self, part: int, varying: Varying) -> Float32:
        """Return the amount (n, P) of each local layer at the fragments of a part."""
        return self.weights.amounts(varying)[:, self.transport.scene.part_slice(part)]

    def frame(
        self, part: int, base: PartFrame, varying: Varying, finished: bool = True
    ) -> PartFrame:
        """Return the frame of a part; only fragments whose amounts changed are computed.

        Parameters
        ----------
        part : int
            Index of the part.
        base : PartFrame
            The part as it is where nothing is painted locally.
        varying : Varying
        finished : bool
            Whether there are as many knots as wanted where rims of layers cross.
        """
        known = self.transport.parts[part]
        if known is None:
            return base
        amounts, paint = self.amounts(part, varying), self._paint(part, varying, finished)
        state = self._states.get(part)
        painted = np.asarray((amounts > 0.0).any(axis=0))
        before = None if state is None or state.base is not base else self._carried(state, paint)
        if state is not None and before is not None:
            most = max(len(before), len(amounts))
            fresh = (_padded(amounts, most) != _padded(before, most)).any(axis=0)
            if finished:
                fresh |= state.rough
            if not fresh.any() and state.paint is paint:
                return state.frame
            radiance, serial = state.frame.radiance.clone(), state.frame.serial
            errors, rough = state.errors.copy(), state.rough.copy()
        else:
            fresh, radiance, serial = painted, base.radiance.clone(), base.serial
            count = amounts.shape[1]
            errors = np.tile(np.array([base.deviation, base.level], np.float32), (count, 1))
            rough = np.zeros(count, np.bool_)
        bare = np.flatnonzero(fresh & ~painted)
        if len(bare):
            gone = torch.from_numpy(bare).to(radiance.device)
            radiance[gone] = base.radiance[gone]
            errors[bare], rough[bare] = (base.deviation, base.level), False
        some = np.flatnonzero(fresh & painted)
        for own, layers, places in paint.groups(amounts[:, some]):
            at = some[own]
            found = self._shade(part, paint, (places, at), layers, finished)
            radiance[torch.from_numpy(at).to(radiance.device)] = found[0]
            errors[at], rough[at] = found[1:]
        if paint.corrections and len(some):
            where = torch.from_numpy(some).to(radiance.device)
            shares = amounts[:, some] / np.array(paint.scale, np.float32)[:, None]
            more = torch.from_numpy(_correction(paint, shares, some))
            radiance[where] = (radiance[where] + more.to(radiance.device)).clamp_min_(0.0)
        changed = torch.from_numpy(np.flatnonzero(fresh)).to(radiance.device)
        deviation, level = errors.mean(axis=0).tolist()
        frame = PartFrame(radiance, deviation, level, (serial, changed))
        self._states[part] = _PartState(paint, base, amounts, frame, errors, rough)
        return frame

    def _carried(self, state: _PartState, paint: _Paint) -> Float32 | None:
        """Return the amounts of the last frame if where these stay, so does what is shown.

        This is so for the same layers, and with some more or less on top.
        """
        old, new = _told(state.paint.varying), _told(paint.varying)
        count = min(len(old), len(new))
        same = state.paint.varying.start == paint.varying.start and old[:count] == new[:count]
        further = (*old[count:], *new[count:])
        return state.amounts if same and all(weight is None for _, weight in further) else None

    def _paint(self, part: int, varying: Varying, finished: bool) -> _Paint:
        """Return what is known of a part's layers, whatever their masks.

        Knots lie between 0 and the opacity of a layer, which most of its fragments have. As long as
        opacities are dragged, they lie between 0 and 1.
        """
        told, start = _told(varying), varying.start
        scale = tuple(layer.strength for layer in varying.local)
        below = self._paints.get((part, start, told[:-1], scale[:-1]))
        if told[-1][1] is not None or below is None or below.values is None:
            below = None
        if not finished and below is None and (part, start, told, scale) not in self._paints:
            scale = (1.0,) * len(scale)
        key = part, start, told, scale
        if key not in self._paints:
            fresh = self._paints[key] = _Paint(varying, scale)
            if below is not None and below.values is not None and below.scale == scale[:-1]:
                # under a layer on top that is not there, all is as it was
                fresh.corrections = {(*key, 0): known for key, known in below.corrections.items()}
                fresh.add([(*key, 0) for key in below.place], below.values[: len(below.place)])
            if len(self._paints) > 6 * len(self.transport.parts):
                self._paints.popitem(last=False)
        self._paints.move_to_end(key)
        return self._paints[key]

    def _shade(
        self,
        part: int,
        paint: _Paint,
        where: tuple[Float32, Int64],
        layers: list[_Axis],
        finished: bool,
    ) -> tuple[torch.Tensor, Float32, bool]:
        """Shade fragments at the rims of the same layers.

        Returns their radiance (m, 3), deviation and level (m, 2), and whether there should be more
        knots.
        """
        (places, fragments), transport = where, self.transport
        known = transport.parts[part]
        assert known is not None
        basis, device = transport.bases[known.group], transport.device
        rough = not finished and any(layer not in paint.steps for layer in layers)
        wanted = self._wanted(part, paint, layers, finished)
        steps = fewer(wanted, MOST_KNOTS[finished])
        stencil = _Stencil.of(places, layers, steps)
        while max(steps, default=1) > 1:
            lacking = sum(key not in paint.place for key in stencil.keys)
            if lacking <= self._left:
                break
            steps = fewer(steps, math.prod(s + 1 for s in steps) - 1)
            stencil = _Stencil.of(places, layers, steps)
        shown = torch.empty((len(fragments), 3), dtype=torch.float32, device=device)
        errors = torch.empty((len(fragments), 2), dtype=torch.float32, device=device)
        rank = basis.rank
        rows = self._at_knots(part, paint, stencil.keys)
        chunk = max(_ENTRIES // stencil.weight.shape[1], 1)
        for start in range(0, len(fragments), chunk):
            some = slice(start, start + chunk)
            mixed = stencil.sums(paint, rows, some)
            at = torch.from_numpy(fragments[some]).to(device)
            images = basis.basis[known.span][at].float()
            found = torch.bmm(mixed[:, : 3 * rank].view(-1, 3, rank), images[:, :, None])[..., 0]
            found.clamp_min_(0.0)
            mirror = mixed[:, 3 * rank : -2].clamp_min(0.0)
            if bool((mirror > 0.0).any()):
                found += mirror * known.mirror[at]
            shown[some], errors[some] = found, mixed[:, -2:]
        return shown, errors.cpu().numpy(), rough or steps != fewer(wanted, MOST_KNOTS[True])

    def _wanted(
        self, part: int, paint: _Paint, layers: list[_Axis], measure: bool = True
    ) -> list[int]:
        """Return how many steps layers need whose rims cross."""
        steps = [self._steps(part, paint, layer, measure) for layer in layers]
        # a mixture goes straight, but what lies above it does not
        return [*(max(step, FEWEST) for step in steps[:-1]), *steps[-1:]]

    def _steps(self, part: int, paint: _Paint, layer: _Axis, measure: bool = True) -> int:
        """Return how many steps between knots a layer needs; `FEWEST` until that is measured."""
        if layer in paint.steps or not measure:
            return paint.steps.get(layer, FEWEST)
        steps = 1
        # with and without the layers below: they bend the way
        for others in (0.0, 1.0) if layer[0] > 0 else (0.0,):
            while steps < FINEST:
                error = self._bend(part, paint, layer, steps, others)
                if error <= (_STRAIGHT if steps == 1 else _SMOOTH):
                    break
                steps = max(2 * steps, FEWEST)
        paint.steps[layer] = steps
        return steps

    def _bend(self, part: int, paint: _Paint, layer: _Axis, steps: int, below: float) -> float:
        """Return the greatest relative error of responses between knots along one layer.

        Layers above are there wholly, if any are.
        """
        axis, above = layer
        between = (0.25, 0.5, 0.75) if steps == 1 else (np.arange(steps) + 0.5) / steps
        places = np.full((len(paint.varying.local), len(between)), below, np.float32)
        places[axis], places[axis + 1 :] = between, float(above)
        stencil = _Stencil.of(places, [layer], [steps])
        known = self._at_knots(part, paint, stencil.keys)
        whole = np.rint(FINEST * places).astype(np.int64)
        whole[axis] = _knots(whole[axis], layer)
        keys = [tuple(key) for key in whole.T.tolist()]
        rows = self._at_knots(part, paint, keys)
        found = stencil.sums(paint, known, slice(None))
        assert paint.values is not None
        exact = paint.values[torch.from_numpy(rows).to(found.device)]
        off = self._on_probes(part, found - exact).abs().mean(dim=(1, 2))
        return float((off / exact[:, -1].clamp_min(1e-30)).max())

    def _on_probes(self, part: int, responses: torch.Tensor) -> torch.Tensor:
        """Return what the basis shows at a part's probes: (K, 3, m)."""
        known = self.transport.parts[part]
        assert known is not None
        basis = self.transport.bases[known.group]
        images = basis.basis[known.span][known.probes.expand(3, -1)].float()
        coefficients = responses[:, : 3 * basis.rank].reshape(len(responses), 3, basis.rank)
        return torch.einsum("kcr,cmr->kcm", coefficients, images)

    def _at_knots(self, part: int, paint: _Paint, keys: Sequence[tuple[int, ...]]) -> Int64:
        """Return where the responses at knots stand."""
        lacking = [key for key in keys if key not in paint.place]
        if lacking:
            # in this order, neighbours share what lower layers come to
            lacking.sort()
            self._left -= len(lacking)
            varying = paint.varying
            materials = [varying.material(paint.amounts(key)) for key in lacking]
            paint.add(lacking, self._respond(part, materials))
        return np.array([paint.place[key] for key in keys], np.int64)

    def _respond(self, part: int, materials: Sequence[Material]) -> torch.Tensor:
        """Return coefficients, mirror, deviation and level (K, 3 r + 5) of materials."""
        transport = self.transport
        known = transport.parts[part]
        assert known is not None
        basis = transport.bases[known.group]
        fresh = [m for m in dict.fromkeys(materials) if (part, m) not in self._responses]
        if fresh:
            values = np.stack([m.values(self.embedding, transport.cells).T for m in fresh], axis=2)
            tables = torch.from_numpy(values).to(transport.device)  # (3, cells, K)
            seen = tables if basis.place is None else tables[:, basis.place]
            rows = basis.projection, basis.probes[:, known.exact]
            found = torch.cat([torch.matmul(some, seen) for some in rows], dim=1)
            for i, material in enumerate(fresh):
                one = found[:, :, i].contiguous()
                self._responses[part, material] = one
                self._bytes += _size(material, one)
        result, exact = [], []
        for material in materials:
            key = part, material
            self._responses.move_to_end(key)
            whole = self._responses[key]
            mirror = torch.from_numpy(material.mirror.astype(np.float32)).to(whole.device)
            exact.append(whole[:, basis.rank :])
            result.append(torch.cat([whole[:, : basis.rank].ravel(), mirror]))
        while self._bytes > _KNOWN and self._responses:
            (_, material), one = self._responses.popitem(last=False)
            self._bytes -= _size(material, one)
        responses, radiance = torch.stack(result), torch.stack(exact)
        off = (self._on_probes(part, responses).clamp_min(0.0) - radiance).abs().mean(dim=(1, 2))
        level = radiance.mean(dim=(1, 2))
        return torch.cat([responses, off[:, None], level[:, None]], dim=1)

    def rough(self, part: int) -> bool:
        """Return whether a part is shown with fewer knots than wanted."""
        state = self._states.get(part)
        return state is not None and bool(state.rough.any())

    def lacking(self, part: int, varying: Varying) -> list[tuple[int, ...]]:
        """Return the knots of a finished frame of a part that are not known yet.

        Parameters
        ----------
        part : int
            Index of the part.
        varying : Varying
        """
        amounts, paint = self.amounts(part, varying), self._paint(part, varying, True)
        some = amounts[:, (amounts > 0.0).any(axis=0)]
        wanted: dict[tuple[int, ...], None] = {}
        for _, layers, places in paint.groups(some):
            steps = fewer(self._wanted(part, paint, layers), MOST_KNOTS[True])
            wanted |= dict.fromkeys(_Stencil.of(places, layers, steps).keys)
        return sorted(key for key in wanted if key not in paint.place)

    def learn(self, part: int, varying: Varying, knots: Sequence[tuple[int, ...]]) -> None:
        """Compute some of the knots that are `lacking`.

        Parameters
        ----------
        part : int
            Index of the part.
        varying : Varying
        knots : some of what `lacking` returned
        """
        self._at_knots(part, self._paint(part, varying, True), knots)

    def uncorrected(self, part: int, varying: Varying) -> dict[tuple[int, ...], Int64]:
        """Return the fragments of a part that need a correction, by corner; at most some corners.

        Parameters
        ----------
        part : int
            Index of the part.
        varying : Varying
        """
        amounts, paint = self.amounts(part, varying), self._paint(part, varying, True)
        at = np.flatnonzero((amounts > 0.0).any(axis=0))
        if not len(at) or paint.values is None:
            return {}
        shares = Shares.of(amounts[:, at] / np.array(paint.scale, np.float32)[:, None], _HALVES)
        point = np.repeat(at, np.diff(shares.first))
        found: dict[tuple[int, ...], Int64] = {}
        rows = list(paint.place.values())
        knots = np.array([paint.amounts(key) for key in paint.place]) / paint.scale
        for k, corner in enumerate(shares.corners):
            key = tuple(corner.tolist())
            apart = np.abs(knots - corner / _HALVES).max(axis=1)
            row = rows[int(apart.argmin())]
            if apart.min() > _NEAR:
                continue
            deviation, level = paint.values[row, -2:].tolist()
            if deviation <= DOUBTED * level:
                continue
            mine = point[shares.corner == k]
            known = paint.corrections.get(key)
            mine = mine if known is None else mine[np.isnan(known[mine, 0])]
            if len(mine):
                found[key] = mine
        most = sorted(found, key=lambda key: -len(found[key]))[:_CORNERS]
        return {key: found[key] for key in most}

    def halves(self, varying: Varying, corners: Iterable[tuple[int, ...]]) -> list[Material]:
        """Return the materials at corners, as `uncorrected` names these.

        Parameters
        ----------
        varying : Varying
        corners : amounts in units of half the opacity
        """
        scale = [layer.strength / _HALVES for layer in varying.local]
        return [
            varying.material([s * c for s, c in zip(scale, corner, strict=True)])
            for corner in corners
        ]

    def exact(
        self,
        part: int,
        materials: Sequence[Material],
        wanted: Mapping[tuple[int, ...], Int64],
        told: Progress,
    ) -> dict[tuple[int, ...], tuple[Int64, Float32]]:
        """Compute corrections; nothing is changed, so that others may paint meanwhile.

        Parameters
        ----------
        part : int
            Index of the part.
        materials : sequence of Material
            What `halves` made of `wanted`.
        wanted : what `uncorrected` returned
        told : called with (stage, fraction done); may raise to cancel
        """
        transport = self.transport
        tables = [m.values(self.embedding) for m in materials]
        several = np.concatenate(tables, axis=1)
        index = np.unique(np.concatenate([*wanted.values()]))
        start = transport.scene.part_slice(part).start
        exact = np.empty((len(index), len(tables), 3), np.float32)
        pieces = np.array_split(np.arange(len(index)), len(index) // _PIECE + 1)
        for i, some in enumerate(pieces):
            told("painting", i / len(pieces))
            images = transport.operator.images(index[some] + start, several)
            exact[some] = np.einsum("pckc->pkc", images.reshape(len(some), 3, len(tables), 3))
        found = {}
        for k, (corner, at) in enumerate(wanted.items()):
            seen = torch.from_numpy(tables[k][transport.cells]).to(transport.device)
            # alone: the product that frames share belongs to other threads
            basis = transport.shade(part, seen, alone=True).radiance.cpu().numpy()
            found[corner] = at, exact[np.searchsorted(index, at), k] - basis[at]
        return found

    def correct(
        self,
        part: int,
        varying: Varying,
        found: Mapping[tuple[int, ...], tuple[Int64, Float32]],
    ) -> None:
        """Show what `exact` found from now on.

        Parameters
        ----------
        part : int
            Index of the part.
        varying : Varying
        found : what `exact` returned
        """
        paint, state = self._paint(part, varying, True), self._states.get(part)
        for corner, (at, values) in found.items():
            if corner not in paint.corrections:
                size = self.transport.scene.part_slice(part)
                none = np.full((size.stop - size.start, 3), np.nan, np.float32)
                paint.corrections[corner] = none
            paint.corrections[corner][at] = values
            if state is not None:
                state.rough[at] = True
        self.finish(part, varying)

    def finish(self, part: int, varying: Varying) -> None:
        """Finish what is shown of a part, whose knots are not `lacking` any more.

        Parameters
        ----------
        part : int
            Index of the part.
        varying : Varying
        """
        if part in self._states:
            self.frame(part, self._states[part].base, varying)

    def worst(self, part: int, varying: Varying) -> Material:
        """Return the material of the painted place where the basis errs most."""
        state = self._states[part]
        painted = (state.amounts > 0.0).any(axis=0)
        at = int(np.argmax(np.where(painted, state.errors[:, 0], 0.0)))
        return varying.material(np.round(state.amounts[:, at], 2).tolist())

    def error(
        self,
        frames: Sequence[PartFrame],
        varying: Sequence[tuple[int, Varying]],
        rng: np.random.Generator,
        count: int = 48,
    ) -> tuple[float, int]:
        """Measure the error of what is painted locally, against exact rows and exact materials.

        Parameters
        ----------
        frames : sequence of PartFrame, one for each part
            As they are shown.
        varying : for each painted part, its index and `Varying`
        rng : numpy Generator
            Draws fragments.
        count : int
            About how many of them.

        Returns
        -------
        error : float
            Mean |I - I_exact| over mean I.
        painted : int
            Number of painted fragments.
        """
        scene = self.transport.scene
        places = []
        for part, one in varying:
            amounts = self.amounts(part, one)
            places.append((part, one, amounts, np.flatnonzero((amounts > 0.0).any(axis=0))))
        total = sum(len(at) for *_, at in places)
        off, level = 0.0, 0.0
        for part, one, amounts, at in places:
            known, radiance = self.transport.parts[part], frames[part].radiance
            if known is None or not len(at):
                continue
            # of all fragments: a few bright ones have most of the light
            everywhere = torch.from_numpy(at).to(self.transport.device)
            level += float(radiance[everywhere].sum())
            some = min(math.ceil(count * len(at) / total), len(at))
            chosen = np.sort(rng.choice(at, some, replace=False))
            rows = self.transport.exact_rows(chosen + scene.part_slice(part).start)
            materials = [one.material(amounts[:, i].tolist()) for i in chosen]
            tables = np.stack([m.values(self.embedding) for m in materials])
            exact = np.einsum("pcn,pnc->pc", rows, tables)
            here = torch.from_numpy(chosen).to(self.transport.device)
            mirrors = np.stack([m.mirror for m in materials])
            exact += mirrors * known.mirror[here].cpu().numpy()
            shown = radiance[here].cpu().numpy()
            off += float(np.abs(shown - exact).sum()) * len(at) / some
        return (off / level if level > 0.0 else off), total


def _correction(paint: _Paint, places: Float32, fragments: Int64) -> Float32:
    """Return what is known to be missing (m, 3) at fragments with amounts (n, m) of the scale."""
    shares = Shares.of(places, _HALVES)
    whole = np.zeros((len(fragments), 3), np.float32)
    for k, corner in enumerate(shares.corners):
        known = paint.corrections.get(tuple(corner.tolist()))
        if known is not None:
            entries = np.flatnonzero(shares.corner == k)
            point = np.searchsorted(shares.first, entries, side="right") - 1
            more = shares.share[entries, None] * known[fragments[point]]
            whole[point] += np.nan_to_num(more)
    return whole


def _knots(index: Int64, layer: _Axis) -> Int64:
    """Return entries of knots' keys, of indices from 0 to FINEST along a layer."""
    inner = (index > 0) & (index < FINEST)
    return np.where(inner & layer[1], index + FINEST, index)


def _patterns(mask: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Int64]:
    """Return the distinct columns (K, n) of a mask (n, m), and which each is."""
    if len(mask) > 16:
        found, which = np.unique(mask, axis=1, return_inverse=True)
        return found.T, which.ravel().astype(np.int64)
    code = (mask * (1 << np.arange(len(mask)))[:, None]).sum(axis=0, dtype=np.int64)
    present = np.flatnonzero(np.bincount(code, minlength=1 << len(mask)))
    place = np.zeros(1 << len(mask), np.int64)
    place[present] = np.arange(len(present))
    return (present[:, None] >> np.arange(len(mask)) & 1).astype(bool), place[code]


def _told(varying: Varying) -> tuple[tuple[int, float | None], ...]:
    """Return the effects of a part's layers, and the weights of those of whole parts."""
    return tuple(
        (id(layer.effect), None if layer.local else layer.weight(varying.part))
        for layer in varying.layers
    )


def _padded(amounts: Float32, count: int) -> Float32:
    """Return amounts (count, P), where layers that are not there have none."""
    return np.pad(amounts, ((0, count - len(amounts)), (0, 0)))


def _size(material: Material, response: torch.Tensor) -> int:
    own = 0 if material.offset is None else material.offset.nbytes
    return response.numel() * 4 + own


# -- drafts ---------------------------------------------------------------------------------------


def blends(
    scene: Scene,
    varying: Mapping[str, Varying],
    weights: SurfaceWeights,
    values: Callable[[Material], Float32],
    most: int = 24,
) -> dict[int, Blend]:
    """Return what drafts show of parts that are painted locally, by index of the part.

    Parameters
    ----------
    scene : Scene
    varying : mapping of part to Varying
    weights : SurfaceWeights, of the scene
    values : callable
        Decodes a material.
    most : int
        Most materials of each part, if the ends of all layers are not more.
    """
    found = {}
    for name, one in varying.items():
        part = scene.parts.index(name)
        made = _blend(scene.part_slice(part), one, weights, values, most)
        if made is not None:
            found[part] = made
    return found


def _blend(
    span: slice,
    varying: Varying,
    weights: SurfaceWeights,
    values: Callable[[Material], Float32],
    most: int,
) -> Blend | None:
    amounts = weights.amounts(varying)[:, span]
    at = np.flatnonzero((amounts > 0.0).any(axis=0))
    if not len(at):
        return None
    steps = 8
    shares = Shares.of(amounts[:, at], steps)
    while len(shares.corners) > most and steps > 1:
        steps //= 2
        shares = Shares.of(amounts[:, at], steps)
    materials = [varying.material((corner / steps).tolist()) for corner in shares.corners]
    mirrors = np.stack([m.mirror for m in materials]).astype(np.float32)
    return Blend(at, shares, [values(m) for m in materials], mirrors)
