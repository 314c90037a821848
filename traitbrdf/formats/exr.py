"""Read OpenEXR images by the OpenEXR package, without a word from it and without its crashes.

The package prints on damaged pixels, to the process's own stdout and stderr. So what it is given is
checked first: the header, the table of chunks, and whether the pixels of simple compressions can be
decoded at all. Others are decoded in a process of their own.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from traitbrdf.formats.files import (
    MOST_PIXELS,
    FormatError,
    PathName,
    file_size,
    fits_in_memory,
    open_binary,
)

Float32 = NDArray[np.float32]

MAGIC = b"\x76\x2f\x31\x01"

_CHUNK_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, 10: 256, 11: 32}
"""Scanlines of a chunk, by compression."""

_BYTES = {0: 4, 1: 2, 2: 4}
"""Bytes of a number, by the type of a channel: uint, half, float."""

_SIZES = {
    "box2i": 16, "compression": 1, "lineOrder": 1, "float": 4, "v2f": 8, "chromaticities": 32,
    "envmap": 1, "tiledesc": 9, "int": 4, "double": 8, "v3f": 12, "v2i": 8, "v3i": 12, "m33f": 36,
    "m44f": 64, "rational": 8, "timecode": 8, "keycode": 28,
}  # fmt: skip


@dataclass(frozen=True)
class _Channel:
    name: str
    kind: int
    sampling: tuple[int, int]


@dataclass(frozen=True)
class _Part:
    """What the header says of one part."""

    channels: tuple[_Channel, ...]
    data: tuple[int, int, int, int]
    display: tuple[int, int, int, int]
    compression: int
    tiled: bool
    chromaticities: tuple[float, ...] | None
    cube: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the data window."""
        x0, y0, x1, y1 = self.data
        return y1 - y0 + 1, x1 - x0 + 1

    @property
    def row_bytes(self) -> int:
        """Bytes of one row of all channels."""
        return self.shape[1] * sum(_BYTES[c.kind] for c in self.channels)


@dataclass(frozen=True)
class EXRImage:
    """A linear image of an OpenEXR file, as stored.

    Parameters
    ----------
    pixels : (H, W, 3) float32
        The display window; black where there are no data.
    chromaticities : (8,) floats or None
        x and y of red, green, blue and white, if the file names them.
    cube : bool
        Whether it is an environment map of six faces, stacked.
    """

    pixels: Float32
    chromaticities: tuple[float, ...] | None
    cube: bool


def read_exr(path: PathName) -> EXRImage:
    """Read the first part that has colours, or luminance.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    FormatError
        If the file is damaged, deep, or has no channels R, G, B or Y at full resolution.
    """
    with open_binary(path) as file:
        file.seek(4)
        parts, sure = _headers(path, file)
        number, names = _colours(path, parts)
        part = parts[number]
        sure = sure and len(parts) == 1 and not part.tiled and _sound_chunks(path, file, part)
    planes = _planes(path, number, names, sure)
    height, width = part.shape
    if any(plane.shape != (height, width) for plane in planes):
        raise FormatError(path, f"{height} x {width} pixels", f"{planes[0].shape}")
    stored = np.stack([*planes] * (3 // len(planes)), axis=-1)
    return EXRImage(_displayed(path, stored, part), part.chromaticities, part.cube)


def _displayed(path: PathName, stored: Float32, part: _Part) -> Float32:
    """Return the display window of what the data window holds."""
    if part.data == part.display:
        return stored
    x0, y0, x1, y1 = part.display
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if not (
        width > 0 and height > 0 and width * height <= MOST_PIXELS
        and fits_in_memory(12 * width * height, stored.nbytes)
    ):  # fmt: skip
        raise FormatError(path, f"at most {MOST_PIXELS} pixels", f"a {width} x {height} image")
    shown = np.zeros((height, width, 3), np.float32)
    left, top = part.data[0] - x0, part.data[1] - y0
    rows = slice(max(top, 0), max(min(top + len(stored), height), 0))
    columns = slice(max(left, 0), max(min(left + stored.shape[1], width), 0))
    shown[rows, columns] = stored[
        rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
    ]
    return shown


def _colours(path: PathName, parts: list[_Part]) -> tuple[int, list[str]]:
    """Return a part's number and its channels of colour, or of luminance."""
    for number, part in enumerate(parts):
        known = {c.name: c for c in part.channels}
        layers = sorted({n[:-1] for n in known if n.endswith(".R")})
        found = next(
            ([f"{layer}{c}" for c in "RGB"] for layer in ("", *layers)
             if all(f"{layer}{c}" in known for c in "RGB")), [],
        )  # fmt: skip
        if not found and "Y" in known and not {"RY", "BY"} & set(known):  # subsampled chroma
            found = ["Y"]
        if found and found[0] != "R" and len(layers) > 1:
            named = ", ".join(layer[:-1] for layer in layers)
            raise FormatError(path, "channels R, G, B of one layer", f"layers {named}")
        if not found:
            continue
        sampling = {known[name].sampling for name in found}
        if sampling != {(1, 1)}:
            raise FormatError(path, "channels at full resolution", f"sampling {sorted(sampling)}")
        return number, found
    names = ", ".join(sorted(c.name for part in parts for c in part.channels))
    raise FormatError(path, "channels R, G, B or Y", f"channels {names or 'none'}")


# ---------------------------------------------------------------------------------------------
# Headers


class _Header:
    """The bytes of a header, taken one after another."""

    def __init__(self, path: PathName, file: BinaryIO) -> None:
        self.path, self.file, self.size = path, file, file_size(file)

    def take(self, count: int, what: str) -> bytes:
        data = self.file.read(count) if 0 <= count <= self.size else b""
        if count < 0 or len(data) < count:
            raise FormatError(
                self.path, "a complete OpenEXR file", f"{self.size} bytes, cut within {what}"
            )
        return data

    def name(self) -> str:
        letters = b""
        while (letter := self.take(1, "the header")) != b"\0":
            letters += letter
            if len(letters) > 255:  # the format's own limit
                raise FormatError(
                    self.path, "an OpenEXR header", "an attribute name without an end"
                )
        return letters.decode("utf-8", "replace")


def _headers(path: PathName, file: BinaryIO) -> tuple[list[_Part], bool]:
    """Return what the headers say, and whether nothing in them is out of the ordinary."""
    header = _Header(path, file)
    (flags,) = struct.unpack("<I", header.take(4, "the header"))
    if flags & 0xFF != 2 or flags & 0x800:
        kind = "deep data" if flags & 0x800 else f"version {flags & 0xFF}"
        raise FormatError(path, "an OpenEXR 2 image of flat pixels", kind)
    parts, sure, multiple = [], not flags & ~0x602, bool(flags & 0x1000)
    while True:
        attributes: dict[str, tuple[str, bytes]] = {}
        while key := header.name():
            kind = header.name()
            (length,) = struct.unpack("<i", header.take(4, "the header"))
            value = header.take(length, "the header")
            sure &= _SIZES.get(kind, length) == length and key not in attributes
            sure &= kind in (*_SIZES, "chlist", "string")
            attributes[key] = kind, value
        if not attributes:
            break
        parts.append(_part(path, attributes, bool(flags & 0x200)))
        if not multiple:
            break
        if len(parts) > 1 << 10:
            raise FormatError(path, "at most 1024 parts", "more")
    if not parts:
        raise FormatError(path, "an OpenEXR header", "no attributes")
    needed = sum(p.shape[0] * max(p.row_bytes, 12 * p.shape[1]) for p in parts)
    if not fits_in_memory(needed, header.size):
        raise FormatError(
            path, "pixels that its size can hold", f"{header.size} bytes for {needed}"
        )
    return parts, sure


def _part(path: PathName, attributes: dict[str, tuple[str, bytes]], tiled: bool) -> _Part:
    """Return what a header's attributes say."""

    def of(key: str, kind: str) -> bytes | None:
        if key not in attributes:
            return None
        if attributes[key][0] != kind or len(attributes[key][1]) != _SIZES.get(kind, -1):
            raise FormatError(path, f"{key} of type {kind}", f"type {attributes[key][0]}")
        return attributes[key][1]

    window, compression = of("dataWindow", "box2i"), of("compression", "compression")
    if window is None or compression is None or "channels" not in attributes:
        raise FormatError(
            path,
            "an OpenEXR header with dataWindow, compression and channels",
            f"{len(attributes)} attributes without them",
        )
    kind = attributes.get("type", ("string", b"scanlineimage"))[1]
    if kind.startswith(b"deep"):
        raise FormatError(path, "an OpenEXR 2 image of flat pixels", "deep data")
    x0, y0, x1, y1 = data = struct.unpack("<4i", window)
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise FormatError(path, f"at most {MOST_PIXELS} pixels", f"a {width} x {height} image")
    display = of("displayWindow", "box2i")
    chromaticities, envmap = of("chromaticities", "chromaticities"), of("envmap", "envmap")
    tiles = of("tiles", "tiledesc")
    if tiles is not None:
        across, down = struct.unpack("<2I", tiles[:8])
        if not (0 < across <= 1 << 14 and 0 < down <= 1 << 14 and across * down <= 1 << 24):
            raise FormatError(path, "tiles of at most 2^24 pixels", f"{across} x {down}")
    return _Part(
        _channels(path, attributes["channels"][1]),
        (data[0], data[1], data[2], data[3]),
        struct.unpack("<4i", window if display is None else display),
        compression[0],
        tiled or tiles is not None,
        None if chromaticities is None else struct.unpack("<8f", chromaticities),
        envmap is not None and envmap[0] == 1,
    )


def _channels(path: PathName, data: bytes) -> tuple[_Channel, ...]:
    found = []
    while data[:1] not in (b"\0", b""):
        name, _, rest = data.partition(b"\0")
        if len(rest) < 16:
            raise FormatError(path, "a list of channels", "one that is cut")
        kind, _, across, down = struct.unpack("<iIii", rest[:16])
        if kind not in _BYTES or across < 1 or down < 1:
            raise FormatError(
                path, "channels of type uint, half or float", f"type {kind}, {across} x {down}"
            )
        found.append(_Channel(name.decode("utf-8", "replace"), kind, (across, down)))
        data = rest[16:]
    return tuple(found)


# ---------------------------------------------------------------------------------------------
# Pixels


def _sound_chunks(path: PathName, file: BinaryIO, part: _Part) -> bool:
    """Find truncation in the table of chunks; return whether all chunks can surely be decoded.

    As documented in "OpenEXR File Layout". That is known of pixels without compression and of ZIP's
    kinds.
    """
    size, lines = file_size(file), _CHUNK_LINES.get(part.compression)
    if lines is None:
        return False
    height, count = part.shape[0], -(-part.shape[0] // lines)
    table = file.read(8 * count)
    if len(table) < 8 * count:
        raise FormatError(
            path, "a complete OpenEXR file", f"{size} bytes, cut within the table of chunks"
        )
    sure = part.compression in (0, 2, 3)
    for i, offset in enumerate(np.frombuffer(table, "<u8").tolist()):
        y, length = 0, size
        if 0 < offset <= size - 8:  # an interrupted writer leaves zeros in the table
            file.seek(offset)
            y, length = struct.unpack("<iI", file.read(8))
        if offset + 8 + length > size:
            raise FormatError(path, "a complete OpenEXR file", f"{size} bytes, cut within pixels")
        if sure:
            whole = min(lines, height - i * lines) * part.row_bytes
            sure = y == part.data[1] + i * lines and length <= whole
            if sure and length < whole:
                sure = part.compression != 0 and _inflates(file.read(length), whole)
    return sure


def _inflates(data: bytes, size: int) -> bool:
    """Return whether zlib makes so many bytes of the data, and no more."""
    stream = zlib.decompressobj()
    try:
        return len(stream.decompress(data, size + 1)) == size and stream.eof
    except zlib.error:
        return False


_CHILD = """
import io, json, sys
sys.path += json.loads(sys.argv[1])
out, sys.stdout = sys.stdout.buffer, io.StringIO()
try:
    import numpy, OpenEXR
    with OpenEXR.File(sys.argv[2], separate_channels=True) as file:
        channels = file.parts[int(sys.argv[3])].channels
        planes = [channels[name].pixels for name in json.loads(sys.argv[4])]
    for plane in planes:
        plane = numpy.ascontiguousarray(plane, dtype="<f4")
        out.write(json.dumps(plane.shape).encode() + b"\\n")
        out.write(plane.tobytes())
    out.flush()
except Exception as error:
    print((" ".join(sys.stdout.getvalue().split()) or repr(error))[:400], file=sys.stderr)
    sys.exit(1)
"""


def _planes(path: PathName, part: int, names: list[str], sure: bool) -> list[Float32]:
    """Return the channels (H, W) of a part."""
    interpreter = Path(sys.executable or "none")
    if sure or getattr(sys, "frozen", False) or not interpreter.name.startswith(("py", "Py")):
        try:
            with OpenEXR.File(str(path), separate_channels=True) as file:
                channels = file.parts[part].channels
                return [np.asarray(channels[name].pixels, np.float32) for name in names]
        # what OpenEXR raises on damage
        except (RuntimeError, ValueError, TypeError, KeyError, IndexError) as error:
            raise FormatError(path, "a readable OpenEXR image", str(error)) from error
    places = sorted({str(Path(m.__file__ or ".").parents[d]) for m, d in ((np, 1), (OpenEXR, 0))})
    ran = subprocess.run(
        [str(interpreter), "-I", "-c", _CHILD, json.dumps(places), str(Path(path).resolve()),
         str(part), json.dumps(names)],
        capture_output=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if ran.returncode:
        said = ran.stderr.decode("utf-8", "replace").strip().splitlines()
        got = said[-1] if said else f"pixels that end its decoder with code {ran.returncode}"
        raise FormatError(path, "a readable OpenEXR image", got)
    data, found = ran.stdout, []
    for _ in names:
        shape, _, data = data.partition(b"\n")
        height, width = json.loads(shape)
        plane: Any = np.frombuffer(data, "<f4", height * width).reshape(height, width)
        found.append(plane.astype(np.float32))
        data = data[plane.nbytes :]
    return found
