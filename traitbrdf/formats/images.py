"""Read and write images: OpenEXR, Radiance and PNG."""

from __future__ import annotations

import contextlib
import io
import math
import struct
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from traitbrdf.formats.files import FormatError, PathName, atomic_path, file_size, open_binary

Float32 = NDArray[np.float32]
_MAX_PIXELS = 1 << 27  # 16384 x 8192; a header that asks for more counts as damaged
_HALF_LIMIT = 65520.0  # numbers from here on round to infinity in half precision


# ---------------------------------------------------------------------------------------------
# images


def read_image(path: PathName) -> Float32:
    """Read a linear OpenEXR or Radiance image; the content decides, not the extension.

    OpenEXR: the channels R, G, B (or Y alone, repeated) of the first part, half or float, the
    pixels of the data window; alpha is dropped. Radiance: flat and run-length encoded scanlines
    (Ward, "Real Pixels", Graphics Gems II, 1991).

    Parameters
    ----------
    path : path-like

    Returns
    -------
    (H, W, 3) float32
        The stored values, including negative and non-finite ones.

    Raises
    ------
    FileNotFoundError
    FormatError
        If the file is neither of the two, truncated, damaged or has no colour channels.
    """
    with open_binary(path) as file:
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
    said = io.StringIO()  # OpenEXR prints on damaged files, and a library must not
    try:
        with (
            contextlib.redirect_stdout(said),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            channels = {name: channel.pixels for name, channel in file.channels().items()}
            sampling = {(c.xSampling, c.ySampling) for c in file.channels().values()}
    except (RuntimeError, ValueError, TypeError) as error:  # OpenEXR raises these on damage
        got = " ".join(said.getvalue().split()) or str(error)
        raise FormatError(path, "a readable OpenEXR image", got) from error
    if all(name in channels for name in "RGB"):
        planes = [channels[name] for name in "RGB"]
    elif "Y" in channels and not {"RY", "BY"} & set(channels):  # RY and BY are subsampled chroma
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
    """Find truncation and absurd sizes before OpenEXR, which would print and allocate first.

    Walks the header and the chunk table as documented in "OpenEXR File Layout". Of multi-part and
    tiled files it checks the header only.
    """
    size = file_size(file)

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
        if 0 < offset <= size - 8:  # an interrupted writer leaves zeros in the table
            file.seek(offset + 4)
            (length,) = struct.unpack("<I", file.read(4))
        if offset + 8 + length > size:
            raise FormatError(path, "a complete OpenEXR file", f"{size} bytes, cut within pixels")


def _decode_radiance(path: PathName, data: bytes) -> Float32:
    """Decode a Radiance picture (Ward, "Real Pixels", Graphics Gems II, 1991).

    Handles flat, old and new run-length scanlines, in either direction of rows and columns. A pixel
    is mantissa * 2^(exponent - 136), as most programs read it (Radiance itself adds half a step to
    the mantissa). EXPOSURE lines are divided out, as the format demands.
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
    # at best a run holds 127 pixels of a channel, or 2^24 pixels in the old format
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
    """Return (height, width, 4) mantissas and exponents of all scanlines from `position` on."""

    def damaged(row: int, what: str) -> FormatError:
        return FormatError(path, f"{height} scanlines of {width} pixels", f"{what} in row {row}")

    rows = []  # row by row: a false size in the header must not allocate memory
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
            else:  # old runs: (1, 1, 1, n) repeats the previous pixel; n shifts by 8 bits each time
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
    """Write a linear image as OpenEXR with channels R, G, B and lossless ZIP compression.

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
        On another shape, or a finite number too large for the precision.
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
    """Write an sRGB image as PNG.

    Parameters
    ----------
    path : path-like
    srgb : (H, W, 3) uint8 array_like
        See `encode_srgb`.

    Raises
    ------
    ValueError
        On another shape or type.
    """
    pixels = _as_image(srgb, np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
