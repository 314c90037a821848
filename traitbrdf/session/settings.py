"""What a session is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypedDict

import torch

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
        "reference" shows exact frames alone, which take seconds.
    error : float or None
        The mean relative L1 that every shown part has to meet by its own measurement (a part
        smaller than a tenth of the shape up to three times as much); parts that do not are
        rendered without the basis, which takes seconds, and taught to it. Of the basis as few
        images are used as 95 % of materials need for it: the more error, the faster. None is
        0.01, and all images.
    fps : float or None
        Frames a second that an edit of the whole object shall reach on this machine: so many
        images of the basis are used, and no frame is exact. The error that it costs is measured
        and reported. Not together with `error`.
    device : torch device for frames
    seed : int, of the preparation's random choices
    cache : bool
        Whether finished preparations are kept on disk: in $TRAITBRDF_CACHE or the user's cache
        folder, the least recently used ones going beyond 2 GB ($TRAITBRDF_CACHE_BYTES; 0 is off).

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
            if asked is not None and not (math.isfinite(asked) and asked > 0.0):
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
        """The device, as torch has it."""
        return torch.device(self.device)
