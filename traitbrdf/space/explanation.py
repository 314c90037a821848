"""How two materials differ, in numbers, words and a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from traitbrdf.space.scores import PALE

if TYPE_CHECKING:
    from traitbrdf.reflectance.brdf import TabulatedBRDF
    from traitbrdf.scene.lights import EnvironmentMap


@dataclass(frozen=True)
class Explanation:
    """How two materials differ, in numbers, words and a picture.

    Attributes
    ----------
    traits : mapping of (float, float)
        By trait, its score before and after.
    descriptors : mapping of (float, float)
        By name (`traitbrdf.reflectance.descriptors.DESCRIPTORS`), a descriptor before and after.
    plausibility : (float, float)
        `TraitSpace.plausibility` before and after, in [0, 1].
    tables : (TabulatedBRDF, TabulatedBRDF)
        The materials themselves.
    """

    traits: Mapping[str, tuple[float, float]]
    descriptors: Mapping[str, tuple[float, float]]
    plausibility: tuple[float, float]
    tables: tuple[TabulatedBRDF, TabulatedBRDF]

    def __str__(self) -> str:
        change = {name: after - before for name, (before, after) in self.traits.items()}
        most = sorted(change, key=lambda name: -abs(change[name]))
        said = [f"{name} {change[name]:+.2f}" for name in most if abs(change[name]) >= 0.05]
        lines = ["traits: " + (", ".join(said[:8]) or "none changed by 0.05")]
        d = self.descriptors
        degrees = [math.degrees(math.exp(value)) for value in d["width"]]
        for what, (before, after), unit in (
            ("gloss at 60 degrees", d["gloss_60"], " GU"),
            ("half width of the lobe", (degrees[0], degrees[1]), " degrees"),
            ("specular albedo", d["specular"], ""),
            ("diffuse albedo", d["diffuse"], ""),
        ):
            lines.append(f"{what}: {before:.3g} to {after:.3g}{unit}")
        for kind in ("diffuse", "specular"):
            hues, chroma = d[f"{kind}_hue"], d[f"{kind}_chroma"]
            if max(chroma) >= PALE:
                lines.append(
                    f"{kind} hue: {hues[0]:.0f} to {hues[1]:.0f} degrees, "
                    f"chroma {chroma[0]:.0f} to {chroma[1]:.0f}"
                )
        before, after = self.plausibility
        lines.append(f"plausibility: {before:.2f} to {after:.2f}")
        return "\n".join(lines)

    def picture(
        self, environment: EnvironmentMap | None = None, size: int = 192
    ) -> NDArray[np.uint8]:
        """Render spheres of both materials side by side.

        Parameters
        ----------
        environment : EnvironmentMap, optional
            The light; a procedural sky if left out.
        size : int
            Height and width of a sphere, in pixels.

        Returns
        -------
        (H, W, 3) uint8, sRGB
        """
        # this import loads torch
        from traitbrdf.pictures import sheet

        return sheet({"": self.tables}, ("before", "after"), environment, size)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        Image.fromarray(self.picture()).save(file, "png")
        return file.getvalue()
