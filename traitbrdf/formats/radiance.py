"""Read Radiance pictures (Ward, "Real Pixels", Graphics Gems II, 1991)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import MOST_PIXELS, FormatError, PathName, fits_in_memory

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class RadiancePicture:
    """A picture, with the exposure and the colour correction of its header divided out.

    Parameters
    ----------
    pixels : (H, W, 3) float32
    primaries : (8,) floats or None
        x and y of red, green, blue and white, if the header names them.
    """

    pixels: Float32
    primaries: tuple[float, ...] | None


def decode_radiance(path: PathName, data: bytes) -> RadiancePicture:
    """Decode a Radiance picture: flat, old and new run-length scanlines, in any orientation.

    A pixel is mantissa * 2^(exponent - 136), as most programs read it (Radiance itself adds half a
    step to the mantissa). EXPOSURE and COLORCORR are divided out, as the format demands; each line
    counts, but not those that begin with a blank, which tell of what the picture was made of.

    Parameters
    ----------
    path : path-like
        Named in errors.
    data : bytes
        The file.

    Raises
    ------
    FormatError
    """
    divisor, primaries, position = _header(path, data)
    end = data.find(b"\n", position)
    words = data[position : max(end, position)].split()
    axes, counts = words[0::2], words[1::2]
    if not (
        len(words) == 4
        and {axis[-1:] for axis in axes} == {b"X", b"Y"}
        and all(axis[:-1] in (b"+", b"-") for axis in axes)
        and all(number.isdigit() and len(number) < 10 for number in counts)
    ):
        shown = data[position : position + 40].decode("latin-1")
        raise FormatError(path, "a resolution line like '-Y 256 +X 512'", repr(shown))
    lines, length = int(counts[0]), int(counts[1])
    if lines < 1 or length < 1 or lines * length > MOST_PIXELS:
        raise FormatError(path, f"1 to {MOST_PIXELS} pixels", f"a {lines} x {length} image")
    # at best a run holds 127 pixels of a channel, or 2^24 pixels in the old format
    enough = (len(data) - end) * (1 << 22) >= lines * length
    if not enough or not fits_in_memory(4 * lines * length, len(data)):
        raise FormatError(path, "a complete Radiance image", f"{len(data)} bytes")
    rgbe = _scanlines(path, data, end + 1, lines, length)
    scale = np.ldexp(np.float64(1.0), rgbe[..., 3:].astype(np.int64) - 136)
    scale[rgbe[..., 3:] == 0] = 0.0
    with np.errstate(over="ignore"):  # whoever takes it for light refuses infinity
        image = (rgbe[..., :3] * scale / divisor).astype(np.float32)
    for axis, way in enumerate(axes):
        if way in (b"+Y", b"-X"):  # from below, or from the right
            image = np.flip(image, axis)
    if axes[0][-1:] == b"X":  # each scanline is a column
        image = np.swapaxes(image, 0, 1)
    return RadiancePicture(np.ascontiguousarray(image), primaries)


def _header(path: PathName, data: bytes) -> tuple[Float64, tuple[float, ...] | None, int]:
    """Return what to divide colours (3,) by, the primaries, and where the header ends."""
    divisor = np.ones(3)
    primaries: tuple[float, ...] | None = None
    position = 0
    while True:
        end = data.find(b"\n", position)
        if end < 0:
            raise FormatError(path, "a Radiance header", f"{len(data)} bytes without its end")
        line = data[position:end].rstrip(b"\r")
        position = end + 1
        if not line.strip():
            return divisor, primaries, position
        key, _, value = line.partition(b"=")
        if key == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise FormatError(path, "FORMAT=32-bit_rle_rgbe", repr(value.decode("latin-1")))
        if key in (b"EXPOSURE", b"COLORCORR"):
            factors = _numbers(value, (1,) if key == b"EXPOSURE" else (3,))
            if factors is None or min(factors) <= 0.0:
                shown = value.strip().decode("latin-1")
                raise FormatError(path, f"a positive {key.decode()}", shown)
            divisor = divisor * factors
        if key == b"PRIMARIES":
            primaries = _numbers(value, (8,))
            if primaries is None:
                raise FormatError(path, "PRIMARIES of eight numbers", value.decode("latin-1"))


def _numbers(value: bytes, counts: tuple[int, ...]) -> tuple[float, ...] | None:
    try:
        found = tuple(float(word) for word in value.split())
    except ValueError:
        return None
    return found if len(found) in counts and all(map(math.isfinite, found)) else None


def _scanlines(
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
