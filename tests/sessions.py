"""Sessions over scenes that are prepared already, and strokes to paint in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.strokes import Stroke, follow
from traitbrdf.scene.scene import Scene
from traitbrdf.session.editing import EditSession
from traitbrdf.transport.transport import Transport


def over(transport: Transport, **arguments: Any) -> EditSession:
    """A new session over a prepared scene; what it trains is its own."""
    again = Transport.restored(
        transport.scene, transport.grid, transport.arrays(), operator=transport.operator
    )  # with the same operator, so that rays are cast once
    return EditSession(transport.scene, **{"quality": "preview", "transport": again, **arguments})


def on(
    scene: Scene, part: str, amount: float = 0.6, trait: str | None = "shiny", **arguments: Any
) -> Stroke:
    """A stroke that touches one part alone."""
    points, radius = follow(scene.part_image == scene.parts.index(part))
    return Stroke(points, trait=trait, amount=amount, radius=radius, **arguments)


def same(first: NDArray[Any], second: NDArray[Any]) -> None:
    np.testing.assert_array_equal(first, second)
