"""Views, and the frames that were shown in them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from traitbrdf.design.document import Varying
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.scene.scene import Scene
from traitbrdf.session.canvas import Canvas
from traitbrdf.session.local import LocalFrames
from traitbrdf.session.preparation import Preparation, Prepared
from traitbrdf.space.material import Material
from traitbrdf.transport.basis import PartFrame
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.nodes import NodeTransport
from traitbrdf.transport.transport import Transport

Float32 = NDArray[np.float32]

FRAMES_KEPT = 1 << 27
"""Bytes of finished parts that are kept, so that what is undone is shown again as it was."""


MOST_TRIED = 4
"""Most materials of a locally painted part whose exact images are added to its basis."""


@dataclass(frozen=True)
class Shown:
    """One part's shading as it is shown.

    Attributes
    ----------
    frame : PartFrame
    tier : how it was made
    seconds : float, what that took
    worst : Material or None
        Where the part is painted locally, the material that the basis shows worst.
    """

    frame: PartFrame
    tier: Literal["basis", "trained", "exact"]
    seconds: float
    worst: Material | None = None

    @property
    def bytes(self) -> int:
        """Bytes of its radiance."""
        return self.frame.radiance.numel() * self.frame.radiance.element_size()


MadeOf: TypeAlias = tuple[tuple[Material, ...], Mapping[str, Varying]]
"""Materials of all parts, and how those of locally painted ones vary."""


class Drafted(NamedTuple):
    """A draft: its image (h, w, 3) and measured error, and what it shows.

    Its size is in pixels, or minus a number of nodes.
    """

    size: int
    made_of: MadeOf
    image: Float32
    error: float


@dataclass(eq=False)
class View:
    """All that is prepared and shown of one scene; the next `look` replaces it as a whole."""

    scene: Scene
    job: Preparation | None = None
    prepared: Prepared | None = None
    canvas: Canvas | None = None
    shown: list[Shown] = field(default_factory=list)
    kept: OrderedDict[tuple[int, Material], Shown] = field(default_factory=OrderedDict)
    kept_bytes: int = 0
    trained: dict[int, int] = field(default_factory=dict)
    budget: dict[int, int] = field(default_factory=dict)
    floor: dict[int, float] = field(default_factory=dict)
    exact_frames: int = 0
    tried: set[tuple[int, Material]] = field(default_factory=set)
    draft: tuple[int, Draft] | None = None
    drafted: Drafted | None = None
    nodes: NodeTransport | None = None
    weights: SurfaceWeights | None = None
    local: LocalFrames | None = None
    times: dict[str, float] = field(default_factory=dict)

    def untried(self, index: int, worst: Material) -> bool:
        """Return whether an exact image of a locally painted part's worst material may still help.

        Parameters
        ----------
        index : int
            Index of the part.
        worst : Material
        """
        mine = {material for part, material in self.tried if part == index}
        return worst not in mine and len(mine) < MOST_TRIED

    def surface(self) -> SurfaceWeights:
        """Return what computes the weights of local masks."""
        if self.weights is None:
            self.weights = SurfaceWeights(self.scene)
        return self.weights

    def keep(self, index: int, material: Material, shown: Shown) -> None:
        """Keep a part's shading; beyond `FRAMES_KEPT` the least recently used is dropped."""
        old = self.kept.pop((index, material), None)
        self.kept_bytes -= 0 if old is None else old.bytes
        self.kept[index, material] = shown
        self.kept_bytes += shown.bytes
        while self.kept_bytes > FRAMES_KEPT and len(self.kept) > len(self.scene.parts):
            _, old = self.kept.popitem(last=False)
            self.kept_bytes -= old.bytes


def measured(view: View, transport: Transport) -> float:
    """Return the measured error of the frame that was shown last."""
    return transport.frame_error([one.frame for one in view.shown])


def enlarged(image: Float32, height: int, width: int) -> Float32:
    """Return a copy of an image (h, w, 3) at another size, bilinear between pixel centres."""
    if image.shape[:2] == (height, width):
        return image.copy()
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    whole = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear")
    return whole[0].permute(1, 2, 0).contiguous().numpy()
