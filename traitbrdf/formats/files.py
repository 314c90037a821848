"""Files that are whole or not there, plain arrays, and errors that name the file."""

from __future__ import annotations

import contextlib
import difflib
import functools
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

PathName = str | PathLike[str]


class FormatError(ValueError):
    """A file that exists but is not what it should be.

    The message names the path, what was expected and what came.
    """

    def __init__(self, path: PathName, expected: str, got: str) -> None:
        self.path = Path(path)
        self.expected = expected
        self.got = got
        super().__init__(f"{self.path}: expected {expected}, got {got}")

    def __reduce__(self) -> tuple[type[FormatError], tuple[Path, str, str]]:
        # the default rebuilds an exception from its message alone and so cannot cross processes
        return FormatError, (self.path, self.expected, self.got)


def stem(path: PathName) -> str:
    """The file name without folder and without its last extension."""
    return Path(path).stem


@contextlib.contextmanager
def atomic_path(path: PathName) -> Iterator[Path]:
    """Write a file whole or not at all.

    Yields the path of a temporary file in the folder of `path` (same extension, not yet created).
    When the block ends well it replaces `path` in one step; on any exception, an interruption
    included, it is removed and what stood at `path` stays.

    Parameters
    ----------
    path : path-like
        Where the file shall stand in the end; a symbolic link keeps pointing to its file.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist, or the block has written no file.
    IsADirectoryError
        If `path` is a folder.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"{path}: expected the path of a file to write, got a folder")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path}: expected an existing folder, got {target.parent}")
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp{target.suffix}"
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(f"{path}: nothing was written to {temporary}")
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())  # else a power cut could leave the new name with no content
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def open_binary(path: PathName) -> BinaryIO:
    try:
        return Path(path).open("rb")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None


def file_size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def unknown_name(kind: str, name: object, known: Sequence[str]) -> str:
    """The message for a name that does not exist: the near ones, and some that do."""
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    some = ", ".join(known[:12]) + (f", ... ({len(known)} in all)" if len(known) > 12 else "")
    return f"unknown {kind} {name!r}: {hint}Known: {some}"


# ---------------------------------------------------------------------------------------------
# The artifact of data_gen


@functools.lru_cache(maxsize=1)
def artifact() -> dict[str, NDArray[Any]]:
    """The arrays that ``python -m data_gen`` packed and the package ships."""
    return read_arrays(resources.files("traitbrdf").joinpath("data", "library.npz"))


def read_arrays(path: Any) -> dict[str, NDArray[Any]]:
    """The named arrays of an ``.npz`` file; nothing in the file is ever executed.

    Parameters
    ----------
    path : a path, or anything with ``open("rb")``

    Raises
    ------
    FileNotFoundError, FormatError
    """
    source = Path(path) if isinstance(path, (str, PathLike)) else path
    try:
        with source.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, OSError, EOFError, KeyError, AttributeError,
            zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        raise FormatError(str(path), "a file of named arrays (.npz)", str(error)) from error


def write_arrays(path: PathName, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays, compressed; atomic. Object arrays are refused (TypeError)."""
    for name, value in arrays.items():
        if value.dtype == object:
            raise TypeError(f"{name}: expected plain numbers or text, got objects")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
