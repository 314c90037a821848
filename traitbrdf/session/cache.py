"""Prepared scenes on disk."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import threading
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from traitbrdf.formats.files import (
    atomic_path,
    read_arrays,
)
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere
from traitbrdf.space.library import Library

Float32 = NDArray[np.float32]

CACHE_BYTES = 2_000_000_000
"""Preparations on disk take at most so many bytes, unless TRAITBRDF_CACHE_BYTES says otherwise."""

_CACHE_FORMAT = 2

_COMPUTES = ("formats", "reflectance", "scene", "space", "transport", "session")
"""Rooms whose code a preparation depends on."""


def _hash(*values: object) -> str:
    """SHA-256 of arrays and of what has a faithful repr."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


@functools.lru_cache(maxsize=1)
def _code() -> str:
    """Return a name of the code that computes: results must not outlive it."""
    try:
        version = importlib.metadata.version("traitbrdf")
    except importlib.metadata.PackageNotFoundError:
        version = ""
    package = Path(str(resources.files("traitbrdf")))
    files = [file for room in _COMPUTES for file in sorted((package / room).glob("**/*.py"))]
    return _hash(version, *(file.read_bytes() for file in [package / "directions.py", *files]))


def cache_key(
    scene: Scene, library: Library, rank: int, resolution: float, seed: int
) -> str | None:
    """Return a name of all that a preparation depends on; None where it cannot be told.

    Parameters
    ----------
    scene : Scene
    library : Library
    rank : int
        Basis images.
    resolution : float
        Of the light.
    seed : int
    """
    shape = scene.shape
    geometry: tuple[object, ...]
    if type(shape) is Mesh:
        geometry = shape.vertices, shape.faces
    elif type(shape) is Sphere or not any(scene.casts):
        geometry = ()
    else:
        return None  # only the shape itself knows what casts shadows
    return _hash(
        _CACHE_FORMAT, _code(), library.embedding.fingerprint(), library.coordinates,
        rank, resolution, seed, scene.height, scene.width, scene.parts, scene.casts,
        scene.ground, scene.shadows, np.asarray(shape.center), shape.radius, shape.lowest,
        *geometry, scene.environment.image, scene.environment.rotation, scene.lights,
        *(getattr(scene, name) for name in _FRAGMENTS),
        # a mesh that was saved and loaded may differ in the last bit
        *(getattr(scene, name).astype(np.float32) for name in _SAMPLES),
    )  # fmt: skip


def fixed_key(whole: str | None, fixed: Mapping[int, Float32]) -> str | None:
    """Return the name of a preparation in which some parts have fixed tables.

    Parameters
    ----------
    whole : str or None
        Name of the preparation that serves all edits.
    fixed : mapping of part index to table (cells, 3)
    """
    if whole is None or not fixed:
        return whole
    return _hash(whole, *(x for pair in fixed.items() for x in pair))


def universal_key(library: Library, seed: int) -> str:
    """Return a name of the universal basis of a library.

    Parameters
    ----------
    library : Library
    seed : int
    """
    return "universal-" + _hash(
        _CACHE_FORMAT, _code(), library.embedding.fingerprint(), library.coordinates,
        seed,
    )  # fmt: skip


_FRAGMENTS = ("pixels", "pixel_part", "weights", "bordering", "offsets")
_SAMPLES = ("normals", "views", "positions", "starts")


class Cache:
    """Finished preparations on disk.

    A disk that is full, read-only or missing raises nothing: scenes are prepared anew.

    Parameters
    ----------
    folder : Path
        Where the files lie; created at the first write.
    limit : int
        Bytes that they may take.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder = folder
        self.limit = limit

    @classmethod
    def usual(cls) -> Cache | None:
        """Return the cache that the environment variables describe; None where it is off.

        Raises
        ------
        ValueError
            If TRAITBRDF_CACHE_BYTES is no number of bytes.
        """
        said = os.environ.get("TRAITBRDF_CACHE_BYTES") or str(CACHE_BYTES)
        try:
            limit = int(said)
        except ValueError:
            limit = -1
        if limit < 0:
            raise ValueError(f"TRAITBRDF_CACHE_BYTES: expected a number of bytes, got {said!r}")
        if limit == 0:
            return None
        chosen = os.environ.get("TRAITBRDF_CACHE")
        if chosen:
            return cls(Path(chosen).expanduser(), limit)
        try:
            folder = user_cache_path("traitbrdf", appauthor=False)
        except RuntimeError:  # a user without a home
            return None
        return cls(folder, limit) if folder.is_absolute() else None

    def file(self, key: str) -> Path:
        """Return the file of a key."""
        return self.folder / f"{key}.npz"

    def read(self, key: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a key; None where they are missing or damaged."""
        path = self.file(key)
        try:
            arrays = read_arrays(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RuntimeError, MemoryError):  # damaged in whatever way
            self.drop(key)
            return None
        with contextlib.suppress(OSError):  # a cache that is only read
            os.utime(path)
        return arrays

    def drop(self, key: str) -> None:
        """Remove the file of a key, if there is one."""
        with contextlib.suppress(OSError):
            self.file(key).unlink(missing_ok=True)

    def write_behind(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write in a thread of its own, so that the first frame does not wait.

        The interpreter waits for the thread when it ends: otherwise a program that shows one frame
        would never fill the cache.
        """
        # the thread of a preparation in the background, which may call this, is a daemon
        thread = threading.Thread(
            target=self.write, args=(key, arrays), name="traitbrdf-cache", daemon=False
        )
        with contextlib.suppress(RuntimeError):  # the interpreter is ending
            thread.start()

    def write(self, key: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write the arrays, and remove the least recently used files beyond the limit."""
        if sum(a.nbytes for a in arrays.values()) > self.limit:
            return
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with atomic_path(self.file(key)) as temporary, temporary.open("wb") as file:
                # compressing takes as long as preparing anew
                np.savez(file, **arrays)  # type: ignore[arg-type]
            self._trim()

    def _trim(self) -> None:
        """Remove the least recently used files, half-written ones of killed processes included."""
        found = [(path.stat(), path) for path in self.folder.glob("*.npz")]
        total = sum(stat.st_size for stat, _ in found)
        for stat, path in sorted(found, key=lambda pair: pair[0].st_mtime_ns):
            if total <= self.limit:
                return
            path.unlink(missing_ok=True)
            total -= stat.st_size
