"""Settings: what a session is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import torch

from traitbrdf.arguments import number
from traitbrdf.formats.files import unknown_name
from traitbrdf.session.budget import QUALITIES


class Asked(TypedDict, total=False):
    """Keywords of `EditSession` that make its `Settings`, beside the quality."""

    error: float | None
    fps: float | None
    device: str | torch.device
    seed: int
    cache: bool


@dataclass(frozen=True)
class Settings:
    """What a session is asked for, as one value.

    Parameters
    ----------
    quality : "preview", "interactive", "accurate" or "reference"
        "reference" shows only exact frames, which take seconds.
    error : float or None
        Mean relative L1 that the measured error of every shown part has to stay below (up to
        three times as much for parts smaller than a tenth of the shape). A part that does not is
        rendered without the basis, which takes seconds, and its image is added to the basis. The
        session uses the fewest basis images with which 95 % of materials meet the error: a larger
        error is faster. None is 0.01, with all images.
    fps : float or None
        Frames a second that edits of the whole object have to reach on this machine. The session
        uses the most basis images that allow it, and no exact frames; it measures and reports the
        error. Not together with `error`.
    device : str or torch.device
        Where frames are computed.
    seed : int
        Seed of the preparation's random choices.
    cache : bool
        Whether finished preparations are kept on disk, in $TRAITBRDF_CACHE or the user's cache
        folder. Beyond 2 GB ($TRAITBRDF_CACHE_BYTES; 0 is off) the least recently used are removed.

    Raises
    ------
    ValueError
        On an unknown quality, an error or a speed that is no positive number, or both of them.
    """

    quality: str = "interactive"
    error: float | None = None
    fps: float | None = None
    device: str | torch.device = "cpu"
    seed: int = 0
    cache: bool = True

    def __post_init__(self) -> None:
        for name, asked in (("error", self.error), ("fps", self.fps)):
            if asked is not None and number(asked, name) <= 0.0:
                raise ValueError(f"{name}: expected a positive number, got {asked!r}")
        if self.error is not None and self.fps is not None:
            raise ValueError(
                f"expected error or fps, got both: error={self.error!r}, fps={self.fps!r}"
            )
        if self.quality not in QUALITIES:
            raise ValueError(unknown_name("quality", self.quality, tuple(QUALITIES)))
        torch.device(self.device)  # an unknown one is told of now

    @property
    def place(self) -> torch.device:
        """The device as a torch.device."""
        return torch.device(self.device)
