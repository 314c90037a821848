"""Compiled code on disk: what is older than its source is removed before anything loads it.

Numba compares a function with its own file alone. But its code contains functions of other files as
well, and it cannot even be read any more once a class that it names has moved.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from platformdirs import user_cache_path

ROOMS = ("reflectance", "scene", "space", "transport")
"""Folders with compiled code; each may contain functions of those before it."""


def drop_outdated(package: Path) -> list[Path]:
    """Remove compiled code that is older than a source file that it may contain.

    What cannot be removed stays.

    Parameters
    ----------
    package : path of the folder that has `ROOMS`

    Returns
    -------
    list of Path
        Index files that were removed; code without its index is compiled anew.
    """
    newest, dropped = 0.0, []
    for room in ROOMS:
        newest = max([newest, *(path.stat().st_mtime for path in (package / room).glob("*.py"))])
        for index in (package / room / "__pycache__").glob("*.nbi"):
            with contextlib.suppress(OSError):  # gone meanwhile, or not ours to remove
                if index.stat().st_mtime < newest:
                    index.unlink()
                    dropped.append(index)
    return dropped


def can_keep(package: Path) -> bool:
    """Return whether compiled code can be kept anywhere: numba refuses to compile if it cannot.

    That is in a folder NUMBA_CACHE_DIR, beside the source, or in the user's cache.

    Parameters
    ----------
    package : path of the folder that has `ROOMS`
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return True
    places = [[package / room / "__pycache__" for room in ROOMS]]
    with contextlib.suppress(RuntimeError):  # a user without a home
        places.append([user_cache_path("numba", appauthor=False)])
    return any(all(_writable(folder) for folder in folders) for folders in places)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


CACHED = can_keep(Path(__file__).parent)
"""Whether compiled code is kept; without that it is compiled anew in each process."""

drop_outdated(Path(__file__).parent)
