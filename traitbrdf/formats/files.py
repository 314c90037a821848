"""Atomic writes, plain arrays, and errors that name the file."""

from __future__ import annotations

import contextlib
import difflib
import functools
import os
import secrets
import shutil
import struct
import tempfile
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


_DENIED = "not allowed to write there"


class FormatError(ValueError):
    """A file exists, but its content is not what was expected.

    The message names the path, what was expected and what was found.

    Parameters
    ----------
    path : path-like
    expected : str
        What the file should hold.
    got : str
        What it holds.
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
    """Return the file name of `path` without its folder and its last extension."""
    return Path(path).stem


def writable(path: PathName) -> Path:
    """Return where a file ends up, links followed, or raise what `atomic_path` would.

    Ask before long work whose result is written.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    FileNotFoundError, IsADirectoryError, PermissionError
    """
    target = Path(os.path.realpath(as_path(path)))
    if target.is_dir():
        raise IsADirectoryError(f"{path}: expected the path of a file to write, got a folder")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path}: expected an existing folder, got {target.parent}")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise PermissionError(f"{path}: {_DENIED}")
    return target


@contextlib.contextmanager
def atomic_path(path: PathName) -> Iterator[Path]:
    """Write a file completely or not at all.

    Yields the path of a temporary file in the folder of `path`, with the same extension; the file
    does not exist yet. If the block succeeds, the temporary file replaces `path` in one step. On
    any exception, including an interruption, it is removed and the old file at `path` stays.

    Parameters
    ----------
    path : path-like
        Where the file ends up. A symbolic link is followed and stays a link. A file that is
        replaced keeps its rights. A device or a pipe is written to, once the content is complete.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist, or the block has written no file.
    IsADirectoryError
        If `path` is a folder.
    PermissionError
        If it may not be written.
    """
    target = writable(path)
    if target.exists() and not target.is_file():  # a device or a pipe stays what it is
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder) / f"whole{target.suffix}"
            yield whole
            with whole.open("rb") as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink)
        return
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp{target.suffix}"
    try:
        try:
            yield temporary
        except PermissionError as error:
            if temporary.name in str(error.filename or ""):
                raise PermissionError(f"{path}: {_DENIED}") from error
            raise
        if not temporary.exists():
            raise FileNotFoundError(f"{path}: nothing was written to {temporary}")
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())  # without it a power cut could leave an empty file
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def open_binary(path: PathName) -> BinaryIO:
    """Open the file at `path` for reading bytes; the FileNotFoundError is one short line."""
    try:
        return as_path(path).open("rb")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise IsADirectoryError(f"{path}: expected a file, got a folder") from None


def as_path(path: object) -> Path:
    """Return a path; the TypeError says what came instead of one."""
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected the path of a file, got {path!r}")
    return Path(path)


def file_size(file: BinaryIO) -> int:
    """Return the size in bytes of an open file `file`."""
    return os.fstat(file.fileno()).st_size


MOST_PIXELS = 1 << 27  # 16384 x 8192; a header that asks for more counts as damaged


def fits_in_memory(needed: int, size: int) -> bool:
    """Return whether a file may become so many bytes: 128 MiB, or 20 times its own size.

    What asks for more is damaged, or made to fill the memory.

    Parameters
    ----------
    needed : int
        Bytes that the content would take.
    size : int
        Bytes of the file.
    """
    return needed <= max(1 << 27, 20 * size)


def unknown_name(kind: str, name: object, known: Sequence[str]) -> str:
    """Return the message for an unknown name: the nearest known names, and some of all names.

    Parameters
    ----------
    kind : str
        What is named, as in "material".
    name : object
        The name that was given.
    known : sequence of str
        All names that exist.
    """
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    some = ", ".join(known[:12]) + (f", ... ({len(known)} in all)" if len(known) > 12 else "")
    return f"unknown {kind} {name!r}: {hint}Known: {some}"


# ---------------------------------------------------------------------------------------------
# Arrays


@functools.lru_cache(maxsize=1)
def artifact() -> dict[str, NDArray[Any]]:
    """Return the arrays that ``python -m data_gen`` packed and the package ships."""
    return read_arrays(resources.files("traitbrdf").joinpath("data", "library.npz"))


def read_arrays(path: Any) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an ``.npz`` file; pickled objects are refused.

    So nothing in the file is ever executed.

    Parameters
    ----------
    path : path-like, or an object with ``open("rb")``

    Returns
    -------
    dict of arrays by name

    Raises
    ------
    FileNotFoundError
    FormatError
        If it is no such file.
    """
    source = Path(path) if isinstance(path, (str, PathLike)) else path
    try:
        with source.open("rb") as file:
            with zipfile.ZipFile(file) as members:
                size = sum(one.compress_size for one in members.infolist())
                needed = sum(one.file_size for one in members.infolist())
            if not fits_in_memory(needed, size):
                raise FormatError(
                    str(path), "arrays that its size can hold", f"{size} bytes for {needed}"
                )
            file.seek(0)
            with np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
        for name, value in arrays.items():  # of members that are no arrays NumPy returns the bytes
            if not isinstance(value, np.ndarray):
                raise ValueError(f"{name!r} is no array")
        return arrays
    except (FileNotFoundError, FormatError):
        raise
    except (ValueError, TypeError, OSError, EOFError, KeyError, AttributeError, MemoryError,
            SyntaxError, RuntimeError, NotImplementedError, zipfile.BadZipFile,
            zlib.error, struct.error) as error:  # fmt: skip
        raise FormatError(str(path), "a file of named arrays (.npz)", str(error)) from error


def write_arrays(path: PathName, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays to a compressed ``.npz`` file, completely or not at all.

    Parameters
    ----------
    path : path-like
    arrays : mapping of str to array

    Raises
    ------
    TypeError
        On an array of Python objects.
    """
    for name, value in arrays.items():
        if value.dtype == object:
            raise TypeError(f"{name}: expected plain numbers or text, got objects")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
