"""Files read and written: linear images (OpenEXR, Radiance), PNG, MERL and RGL materials.

Every reader raises `FileNotFoundError` where there is no file and `FormatError` where there is one
that is not what it should be; sizes named in a header are checked against the size of the file
before anything is allocated. Every writer is atomic (see `atomic_path`): the path holds either the
old file or the complete new one.

Images are (H, W, 3), row 0 at the top, linear Rec.709 RGB. Readers of images return what is stored,
also negative or non-finite numbers: whoever takes them as light has to check them.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import io
import math
import os
import secrets
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image

PathName = str | PathLike[str]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MERL_SCALE: tuple[float, float, float] = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
"""1/sr per stored unit of a MERL ``.binary`` file, red, green, blue (Matusik et al. 2003)."""

_MAX_PIXELS = 1 << 27  # 16384 x 8192: an image header that asks for more is taken to be damaged
_HALF_LIMIT = 65520.0  # from here on a number rounds to infinity in half precision


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


def _open(path: PathName) -> BinaryIO:
    try:
        return Path(path).open("rb")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


# ---------------------------------------------------------------------------------------------
# images


def read_image(path: PathName) -> Float32:
    """Read a linear image, OpenEXR or Radiance, told apart by content and not by extension.

    OpenEXR: the channels R, G, B (or Y alone, repeated) of the first part, half or float, the
    pixels of the data window; alpha is dropped. Radiance: see `_decode_radiance`.

    Returns
    -------
    (H, W, 3) float32
        What is stored, also negative or non-finite numbers.

    Raises
    ------
    FileNotFoundError
    FormatError
        If the file is neither of the two, truncated, damaged or has no colour channels.
    """
    with _open(path) as file:
        start = file.read(4)
        if start == b"\x76\x2f\x31\x01":
            _check_exr(path, file)
        elif start.startswith(b"#?"):
            file.seek(0)
            return _decode_radiance(path, file.read())
        else:
            raise FormatError(
                path,
                "an OpenEXR or Radiance image",
                f"a file that starts with {start!r}" if start else "an empty file",
            )
    return _read_exr(path)


def _read_exr(path: PathName) -> Float32:
    said = io.StringIO()  # at damage OpenEXR prints, and a library has no business doing so
    try:
        with (
            contextlib.redirect_stdout(said),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            channels = {name: channel.pixels for name, channel in file.channels().items()}
            sampling = {(c.xSampling, c.ySampling) for c in file.channels().values()}
    except (RuntimeError, ValueError, TypeError) as error:  # what OpenEXR throws at damage
        got = " ".join(said.getvalue().split()) or str(error)
        raise FormatError(path, "a readable OpenEXR image", got) from error
    if all(name in channels for name in "RGB"):
        planes = [channels[name] for name in "RGB"]
    elif "Y" in channels and not {"RY", "BY"} & set(channels):  # those hold subsampled chroma
        planes = [channels["Y"]] * 3
    else:
        raise FormatError(
            path, "channels R, G, B or Y", f"channels {', '.join(sorted(channels)) or 'none'}"
        )
    if sampling != {(1, 1)} or any(plane.dtype.kind != "f" for plane in planes):
        raise FormatError(
            path,
            "half or float channels at full resolution",
            f"{', '.join(str(p.dtype) for p in planes)}, sampling {sorted(sampling)}",
        )
    return np.stack(planes, axis=-1).astype(np.float32)


_EXR_CHUNK_LINES = {
    0: 1,
    1: 1,
    2: 1,
    3: 16,
    4: 32,
    5: 16,
    6: 32,
    7: 32,
    8: 32,
    9: 256,
    10: 256,
    11: 32,
}


def _check_exr(path: PathName, file: BinaryIO) -> None:
    """Find truncation and absurd sizes before OpenEXR does: it prints, and allocates first.

    Walks header and chunk table as documented in "OpenEXR File Layout"; of multi-part and tiled
    files only the header is walked, the rest is left to OpenEXR.
    """
    size = _size(file)

    def take(count: int, what: str) -> bytes:
        data = file.read(count) if 0 <= count <= size else b""
        if count < 0 or len(data) < count:
            raise FormatError(path, "a complete OpenEXR file", f"{size} bytes, cut within {what}")
        return data

    def name() -> bytes:
        letters = b""
        while (letter := take(1, "the header")) != b"\0":
            letters += letter
            if len(letters) > 255:  # the format's own limit
                raise FormatError(path, "an OpenEXR header", "an attribute name without an end")
        return letters

    (flags,) = struct.unpack("<I", take(4, "the header"))
    if flags & 0xFF != 2 or flags & 0x800:
        kind = "deep data" if flags & 0x800 else f"version {flags & 0xFF}"
        raise FormatError(path, "an OpenEXR 2 image of flat pixels", kind)
    attributes = {}
    while key := name():
        name()  # its type
        (length,) = struct.unpack("<i", take(4, "the header"))
        attributes[key] = take(length, "the header")
    try:
        x0, y0, x1, y1 = struct.unpack("<4i", attributes[b"dataWindow"])
        (compression,) = attributes[b"compression"]
    except (KeyError, ValueError, struct.error):
        raise FormatError(
            path,
            "an OpenEXR header with dataWindow and compression",
            f"{len(attributes)} attributes without them",
        ) from None
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if width < 1 or height < 1 or width * height > _MAX_PIXELS:
        raise FormatError(path, f"at most {_MAX_PIXELS} pixels", f"a {width} x {height} image")
    if flags & (0x200 | 0x1000) or compression not in _EXR_CHUNK_LINES:
        return
    count = -(-height // _EXR_CHUNK_LINES[compression])
    for offset in np.frombuffer(take(8 * count, "the table of chunks"), "<u8").tolist():
        length = size
        if 0 < offset <= size - 8:  # a writer that was interrupted leaves zeros in the table
            file.seek(offset + 4)
            (length,) = struct.unpack("<I", file.read(4))
        if offset + 8 + length > size:
            raise FormatError(path, "a complete OpenEXR file", f"{size} bytes, cut within pixels")


def _decode_radiance(path: PathName, data: bytes) -> Float32:
    """Decode a Radiance picture (Ward, "Real Pixels", Graphics Gems II, 1991).

    Flat, old and new run-length scanlines; rows may run either way, columns too. A pixel is
    mantissa * 2^(exponent - 136), as most programs have it (Radiance itself adds half a step to
    the mantissa); EXPOSURE lines are divided out, as the format demands.
    """
    exposure = 1.0
    position = 0
    while True:
        end = data.find(b"\n", position)
        if end < 0:
            raise FormatError(path, "a Radiance header", f"{len(data)} bytes without its end")
        line = data[position:end].strip()
        position = end + 1
        if not line:
            break
        key, _, value = line.partition(b"=")
        if key == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise FormatError(path, "FORMAT=32-bit_rle_rgbe", repr(value.decode("latin-1")))
        if key == b"EXPOSURE":
            try:
                exposure *= float(value)
            except ValueError:
                exposure = math.nan
    if not (math.isfinite(exposure) and exposure > 0.0):
        raise FormatError(path, "a positive EXPOSURE", str(exposure))
    end = data.find(b"\n", position)
    words = data[position : max(end, position)].split()
    rows, columns = words[0::2], words[1::2]
    if not (
        len(words) == 4
        and rows[0] in (b"-Y", b"+Y")
        and rows[1] in (b"+X", b"-X")
        and all(number.isdigit() and len(number) < 10 for number in columns)
    ):
        shown = data[position : position + 40].decode("latin-1")
        raise FormatError(path, "a resolution line like '-Y 256 +X 512'", repr(shown))
    height, width = int(columns[0]), int(columns[1])
    if height < 1 or width < 1 or width * height > _MAX_PIXELS:
        raise FormatError(path, f"1 to {_MAX_PIXELS} pixels", f"a {width} x {height} image")
    # the shortest scanline is one run per channel and 127 pixels, or old runs of 2^24 pixels
    if (len(data) - end) * (1 << 22) < width * height:
        raise FormatError(path, "a complete Radiance image", f"{len(data)} bytes")
    rgbe = _radiance_pixels(path, data, end + 1, height, width)
    scale = np.ldexp(1.0 / exposure, rgbe[..., 3:].astype(np.int64) - 136)
    scale[rgbe[..., 3:] == 0] = 0.0
    image = (rgbe[..., :3] * scale).astype(np.float32)
    if words[0] == b"+Y":
        image = image[::-1]
    if words[2] == b"-X":
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def _radiance_pixels(
    path: PathName, data: bytes, position: int, height: int, width: int
) -> NDArray[np.uint8]:
    """The (height, width, 4) mantissas and exponents of all scanlines from `position` on."""

    def damaged(row: int, what: str) -> FormatError:
        return FormatError(path, f"{height} scanlines of {width} pixels", f"{what} in row {row}")

    rows = []  # grown row by row: a header that lies meets the end of the file first
    previous = bytes(4)
    for row in range(height):
        start = data[position : position + 4]
        if 8 <= width < 32768 and start == bytes((2, 2, width >> 8, width & 255)):
            position += 4
            line = bytearray()
            while len(line) < 4 * width:  # four channels, one after another
                channel_end = (len(line) // width + 1) * width
                code = data[position] if position < len(data) else 0
                run = code > 128
                count = code - 128 if run else code
                piece = data[position + 1 : position + 1 + (1 if run else count)]
                if len(piece) < (1 if run else count) or position >= len(data):
                    raise damaged(row, "the end of the file")
                if count == 0 or len(line) + count > channel_end:
                    raise damaged(row, f"a run of {count} pixels")
                line += piece * count if run else piece
                position += 1 + len(piece)
            pixels = np.frombuffer(bytes(line), np.uint8).reshape(4, width).T
        else:
            flat = np.frombuffer(data[position : position + 4 * width], np.uint8)
            markers = flat[: len(flat) // 4 * 4].reshape(-1, 4)[:, :3] == 1
            if len(flat) == 4 * width and not markers.all(axis=1).any():
                pixels = flat.reshape(width, 4)
                position += 4 * width
            else:  # old runs: (1, 1, 1, n) repeats the pixel before, shifted 8 bits each time
                line = bytearray()
                shift = 0
                while len(line) < 4 * width:
                    pixel = data[position : position + 4]
                    position += 4
                    if len(pixel) < 4:
                        raise damaged(row, "the end of the file")
                    if pixel[:3] == b"\1\1\1":
                        count = pixel[3] << shift
                        shift += 8
                        if len(line) + 4 * count > 4 * width or shift > 24:
                            raise damaged(row, f"a run of {count} pixels")
                        line += previous * count
                    else:
                        line += pixel
                        previous, shift = pixel, 0
                pixels = np.frombuffer(bytes(line), np.uint8).reshape(width, 4)
        rows.append(pixels)
        previous = pixels[-1].tobytes()
    return np.stack(rows)


def _as_image(image: ArrayLike, dtype: Any) -> NDArray[Any]:
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise ValueError(f"image: expected shape (H, W, 3), got {pixels.shape}")
    if dtype is np.uint8:
        if pixels.dtype != np.uint8:
            raise ValueError(f"srgb: expected uint8 (see encode_srgb), got {pixels.dtype}")
    elif pixels.dtype.kind not in "fiu":
        raise ValueError(f"image: expected real numbers, got {pixels.dtype}")
    return np.ascontiguousarray(pixels)


def write_exr(path: PathName, image: ArrayLike, half: bool = False) -> None:
    """Write an (H, W, 3) linear image as OpenEXR, channels R, G, B, lossless ZIP.

    Parameters
    ----------
    path : path-like
    image : (H, W, 3) array_like
        Stored as float32; non-finite numbers are stored as they are.
    half : bool
        Store 16 instead of 32 bits (relative rounding of 5e-4).

    Raises
    ------
    ValueError
        On another shape, or a finite number too large for the precision asked for.
    """
    pixels = _as_image(image, np.float32)
    limit, kind = (_HALF_LIMIT, np.float16) if half else (3.4028235677973366e38, np.float32)
    largest = float(np.max(np.abs(pixels), where=np.isfinite(pixels), initial=0.0))
    if largest >= limit:
        raise ValueError(f"image: expected values below {limit:.6g}, got {largest:.6g}")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"RGB": pixels.astype(kind)}
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def write_png(path: PathName, srgb: ArrayLike) -> None:
    """Write an (H, W, 3) uint8 sRGB image (see `encode_srgb`) as PNG.

    Raises
    ------
    ValueError
        On another shape or type.
    """
    pixels = _as_image(srgb, np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def encode_srgb(linear: ArrayLike) -> NDArray[np.uint8]:
    """Encode linear Rec.709 values for a display: IEC 61966-2-1, clipped to [0, 1], 8 bits.

    Parameters
    ----------
    linear : (..., 3) array_like
        1 is display white; infinities clip.

    Returns
    -------
    (..., 3) uint8

    Raises
    ------
    ValueError
        On another last axis, or NaN.
    """
    values = np.asarray(linear)
    if values.dtype.kind not in "fiu":
        raise ValueError(f"linear: expected real numbers, got {values.dtype}")
    if values.ndim == 0 or values.shape[-1] != 3:
        raise ValueError(f"linear: expected shape (..., 3), got {values.shape}")
    x = np.clip(values.astype(np.float64), 0.0, 1.0)
    if np.isnan(x).any():
        raise ValueError(f"linear: expected numbers, got {int(np.isnan(x).sum())} NaN")
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1.0 / 2.4) - 0.055)
    return np.asarray(255.0 * encoded + 0.5).astype(np.uint8)


def exposure_of(linear: ArrayLike) -> float:
    """The exposure at which an image (H, W, 3) looks right: its 90th percentile becomes bright."""
    bright = float(np.quantile(np.asarray(linear, np.float64).max(axis=-1), 0.9))
    return 0.8 / bright if bright > 0.0 else 1.0


def tone_map(linear: ArrayLike, exposure: float = 1.0) -> NDArray[np.uint8]:
    """A picture (..., 3) uint8 of linear radiance (..., 3): filmic shoulder, then sRGB.

    The curve is Narkowicz's fit (2015) of the ACES reference rendering; `exposure` scales the
    radiance first.

    Raises
    ------
    ValueError
        On another last axis, NaN, or an exposure that is not positive and finite.
    """
    if not (math.isfinite(exposure) and exposure > 0.0):
        raise ValueError(f"exposure: expected a positive number, got {exposure!r}")
    x = np.clip(np.asarray(linear, np.float64) * exposure, 0.0, 1e6)
    return encode_srgb(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14))


class Display:
    """`tone_map` at one exposure, by table: many times as fast, and within one level of it.

    Parameters
    ----------
    exposure : as for `tone_map`
    """

    _STEPS = 4096
    _WHITE = 16.0  # the curve is flat beyond

    def __init__(self, exposure: float) -> None:
        self.exposure = exposure
        levels = np.arange(int(self._WHITE * self._STEPS)) / self._STEPS
        grey = tone_map(np.repeat(levels[:, None], 3, axis=1) / exposure, exposure)
        self._table = np.ascontiguousarray(grey[:, 0])

    def __call__(self, linear: NDArray[np.float32]) -> NDArray[np.uint8]:
        """(..., 3) uint8 of linear radiance (..., 3) that is not negative and holds no NaN."""
        scaled = linear * np.float32(self.exposure * self._STEPS)
        np.minimum(scaled, np.float32(len(self._table) - 1), out=scaled)
        return self._table[scaled.astype(np.uint16)]


def unknown_name(kind: str, name: object, known: Sequence[str]) -> str:
    """The message for a name that does not exist: the near ones, and some that do."""
    near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    some = ", ".join(known[:12]) + (f", ... ({len(known)} in all)" if len(known) > 12 else "")
    return f"unknown {kind} {name!r}: {hint}Known: {some}"


# ---------------------------------------------------------------------------------------------
# MERL materials


def read_merl(path: PathName) -> Float64:
    """Read a MERL ``.binary`` file (Matusik et al., "A Data-Driven Reflectance Model", 2003).

    Three int32 dimensions, then the planes R, G, B of float64; the scale factors `MERL_SCALE` are
    applied.

    Returns
    -------
    (n_theta_h, n_theta_d, n_phi_d, 3) float64
        f_r in 1/sr; cells that the measurement marks invalid are negative, as stored.

    Raises
    ------
    FileNotFoundError
    FormatError
        If the dimensions are not positive, do not match the size of the file, or a value is not
        finite.
    """
    with _open(path) as file:
        header = file.read(12)
        size = _size(file)
        if len(header) < 12:
            raise FormatError(path, "a MERL header of 12 bytes", f"{len(header)} bytes")
        dims = struct.unpack("<3i", header)
        count = math.prod(dims)
        if min(dims) < 1 or size != 12 + 24 * count:
            shape = " x ".join(map(str, dims))
            needed = f" of {12 + 24 * count} bytes" if min(dims) > 0 else ""
            raise FormatError(
                path, "a MERL file, 90 x 90 x 180 as a rule", f"{size} bytes, {shape}{needed}"
            )
        values = np.empty((*dims, 3))
        for channel, scale in enumerate(MERL_SCALE):
            plane = np.fromfile(file, "<f8", count)
            if len(plane) < count or not np.isfinite(plane).all():
                raise FormatError(
                    path,
                    f"{count} finite values a colour",
                    f"{int(np.isfinite(plane).sum())} in colour {channel}",
                )
            values[..., channel] = plane.reshape(dims) * scale
    return values


def write_merl(path: PathName, values: ArrayLike) -> None:
    """Write a MERL ``.binary`` file; `read_merl` gives the values back to rounding.

    Parameters
    ----------
    path : path-like
    values : (n_theta_h, n_theta_d, n_phi_d, 3) array_like
        f_r in 1/sr on MERL's nodes; 90 x 90 x 180 is what other programs read.

    Raises
    ------
    ValueError
        On another shape, or values that are not finite.
    """
    table = np.asarray(values)
    if table.ndim != 4 or table.shape[-1] != 3 or 0 in table.shape:
        raise ValueError(
            f"values: expected shape (n_theta_h, n_theta_d, n_phi_d, 3), got {table.shape}"
        )
    if not np.isfinite(table).all():
        bad = int(np.count_nonzero(~np.isfinite(table)))
        raise ValueError(f"values: expected finite numbers, got {bad} that are not")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<3i", *table.shape[:3]))
        for channel, scale in enumerate(MERL_SCALE):
            file.write((table[..., channel].astype(np.float64) / scale).astype("<f8").tobytes())


# ---------------------------------------------------------------------------------------------
# RGL materials


@dataclass(frozen=True, eq=False)
class RGLFields:
    """The fields of an RGL material file (Dupuy & Jakob 2018), as stored.

    With p azimuths and t elevations of the first direction: `phi_i` (p,) and `theta_i` (t,) in
    radians, increasing; `sigma` and `ndf` (rows, columns), projected microfacet area and
    distribution; `vndf` (p, t, rows, columns), a density that warps the square; `luminance`
    (p, t, n, n) and `rgb` (p, t, 3, n, n), the measurement on the warped square, linear Rec.709.
    In all of them rows are azimuth and columns are elevation. All are float32 and finite.
    `jacobian` tells whether the measurement is to be multiplied by ndf / (4 sigma).
    """

    phi_i: Float32
    theta_i: Float32
    sigma: Float32
    ndf: Float32
    vndf: Float32
    luminance: Float32
    rgb: Float32
    jacobian: bool
    description: str


_TENSOR_MAGIC = b"tensor_file\0"
_TENSOR_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
_RGL_RANKS = {"phi_i": 1, "theta_i": 1, "sigma": 2, "ndf": 2, "vndf": 4, "luminance": 4, "rgb": 5}


def read_rgl(path: PathName) -> RGLFields:
    """Read an RGL ``.bsdf`` material, the RGB kind (Dupuy & Jakob, "An Adaptive Parameterization
    for Efficient Material Acquisition and Rendering", 2018).

    The container: ``tensor_file\\0``, version 1.0, the number of fields (uint32); a field is the
    length of its name (uint16), the name, its rank (uint16), type (uint8), offset in the file
    (uint64) and shape (uint64 each); little endian.

    Raises
    ------
    FileNotFoundError
    FormatError
        If the file is something else, truncated, of another version, without one of the fields
        (the spectral files have no ``rgb``), or its fields do not fit each other.
    """
    with _open(path) as file:
        table = _tensor_table(path, file)
        arrays: dict[str, NDArray[Any]] = {}
        for name, rank in (*_RGL_RANKS.items(), ("jacobian", 1), ("description", 1)):
            if name not in table:
                raise FormatError(path, f"a field {name!r}", f"fields {', '.join(table)}")
            kind, offset, shape = table[name]
            expected = "<f4" if name in _RGL_RANKS else "u1"
            if kind != expected or len(shape) != rank or 0 in shape:
                raise FormatError(
                    path, f"{name} as {expected} with {rank} axes", f"{kind} of shape {shape}"
                )
            file.seek(offset)
            array = np.fromfile(file, kind, math.prod(shape)).reshape(shape)
            if not np.isfinite(array).all():
                raise FormatError(path, f"finite values in {name}", "others")
            arrays[name] = array
    description = arrays.pop("description").tobytes().decode("utf-8", "replace").rstrip("\0")
    jacobian = bool(arrays.pop("jacobian")[0])
    fields = RGLFields(**arrays, jacobian=jacobian, description=description)
    _check_rgl(path, fields)
    return fields


def _tensor_table(path: PathName, file: BinaryIO) -> dict[str, tuple[str, int, tuple[int, ...]]]:
    """The (type, offset, shape) of every field, checked to lie within the file."""
    size = _size(file)

    def take(layout: str) -> tuple[Any, ...]:
        data = file.read(struct.calcsize(layout))
        if len(data) < struct.calcsize(layout):
            raise FormatError(path, "a complete tensor file", f"{size} bytes, cut in its table")
        return struct.unpack(layout, data)

    magic = file.read(len(_TENSOR_MAGIC))
    if magic != _TENSOR_MAGIC:
        raise FormatError(path, "a tensor file (.bsdf)", f"a file that starts with {magic!r}")
    version = take("<2B")
    if version != (1, 0):
        raise FormatError(path, "tensor file version 1.0", f"version {version[0]}.{version[1]}")
    table: dict[str, tuple[str, int, tuple[int, ...]]] = {}
    for _ in range(take("<I")[0]):
        (length,) = take("<H")
        name = take(f"<{length}s")[0].decode("utf-8", "replace")
        rank, kind, offset = take("<HBQ")
        if not 1 <= kind <= len(_TENSOR_TYPES) or rank > 8 or name in table:
            raise FormatError(
                path,
                "fields of known type, at most 8 axes and different names",
                f"{name!r} of type {kind} with {rank} axes",
            )
        shape = take(f"<{rank}Q")
        dtype = _TENSOR_TYPES[kind - 1]
        needed = math.prod(shape) * np.dtype(dtype).itemsize
        if offset + needed > size:  # Python integers: no overflow to hide behind
            raise FormatError(
                path,
                f"{name} of shape {shape} within the file",
                f"bytes {offset} to {offset + needed} of {size}",
            )
        table[name] = dtype, offset, shape
    return table


def _check_rgl(path: PathName, fields: RGLFields) -> None:
    p, t = len(fields.phi_i), len(fields.theta_i)
    n = fields.luminance.shape[-1]
    shapes: dict[str, tuple[int, ...]] = {
        "sigma": fields.sigma.shape,
        "ndf": fields.ndf.shape,
        "vndf": (p, t, *fields.vndf.shape[2:]),
        "luminance": (p, t, n, n),
        "rgb": (p, t, 3, n, n),
    }
    for name, shape in shapes.items():
        got = getattr(fields, name).shape
        if got != shape or min(shape[-2:]) < 2:
            raise FormatError(
                path,
                f"{name} of {p} azimuths, {t} elevations, at least 2 x 2 nodes",
                f"shape {got}",
            )
    for name in ("phi_i", "theta_i"):
        if np.any(np.diff(getattr(fields, name)) <= 0.0):
            raise FormatError(path, f"increasing {name}", str(getattr(fields, name).tolist()))
    if fields.vndf.min() < 0.0 or fields.vndf.sum(axis=(2, 3)).min() <= 0.0:
        raise FormatError(path, "a vndf that is a density", f"a minimum of {fields.vndf.min()}")
    if fields.sigma.min() <= 0.0 or fields.ndf.min() < 0.0:
        raise FormatError(
            path,
            "positive sigma and ndf",
            f"minima of {fields.sigma.min()} and {fields.ndf.min()}",
        )


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
