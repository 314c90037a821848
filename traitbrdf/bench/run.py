"""The list of benches, and running them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

from traitbrdf.bench.edits import edit_speed, preparation
from traitbrdf.bench.embedding import embedding_error, table_error
from traitbrdf.bench.export import exported
from traitbrdf.bench.live import live_edits
from traitbrdf.bench.local import local_paint
from traitbrdf.bench.records import NAMES, ON_REQUEST, Record, Say
from traitbrdf.bench.rivals import peer_speed
from traitbrdf.bench.trade import promises_kept, trade
from traitbrdf.bench.traits import trait_laws
from traitbrdf.bench.transport import family_error, shadow_error, transport_error

Bench: TypeAlias = Callable[[Path | None, bool, Say], Iterator[Record]]
"""A function of the data folder, whether to be quick, and a callback for lines of progress."""

BENCHES: dict[str, Bench] = dict(
    zip(
        NAMES,
        (
            transport_error, family_error, shadow_error, table_error, embedding_error, edit_speed,
            preparation, live_edits, peer_speed, trait_laws, local_paint, exported,
            promises_kept, trade,
        ),
        strict=True,
    )
)  # fmt: skip
"""All benches by name."""


def run(
    names: list[str],
    data: Path | None,
    quick: bool,
    say: Say,
    benches: Mapping[str, Bench] = MappingProxyType(BENCHES),
) -> list[Record]:
    """Run benches and return their records.

    Parameters
    ----------
    names : list of str
        Names in `benches`; empty for all but those `ON_REQUEST`.
    data : Path or None
        Folder with real maps and measured materials.
    quick : bool
        Whether to use small sizes.
    say : callable
        Receives each line of output when it is known.
    benches : mapping of str to Bench

    Raises
    ------
    ArithmeticError
        If a figure is not finite.
    """
    records = []
    for name in names or [name for name in benches if name not in ON_REQUEST]:
        call = benches[name]
        said = getattr(call, "func", call).__doc__ or name
        say(f"{name}: {said.splitlines()[0]}")
        start = time.perf_counter()
        for record in call(data, quick, say):
            if not math.isfinite(record.value):
                raise ArithmeticError(f"{record.name}: not a finite number")
            records.append(record)
            say(record.line())
        say(f"  ({time.perf_counter() - start:.0f} s)")
    return records
