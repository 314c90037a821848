"""Read and write images: OpenEXR, Radiance and PNG."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from traitbrdf.formats.exr import MAGIC, read_exr
from traitbrdf.formats.files import FormatError, PathName, atomic_path, open_binary
from traitbrdf.formats.radiance import decode_radiance

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
_HALF_LIMIT = 65520.0  # numbers from here on round to infinity in half precision

_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""x and y of red, green, blue and white of Rec.709."""

_PICTURES = {
    b"\x89PNG": "PNG", b"\xff\xd8\xff": "JPEG", b"GIF8": "GIF", b"BM": "BMP", b"RIFF": "WebP",
    b"II*\0": "TIFF", b"MM\0*": "TIFF", b"8BPS": "Photoshop",
}  # fmt: skip
"""What files of other programs begin with."""


@dataclass(frozen=True)
class Picture:
    """A linear picture of a file.

    Parameters
    ----------
    pixels : (H, W, 3) float32
        Linear Rec.709, as stored save for the conversion of primaries.
    converted : bool
        Whether the file had other primaries, so that negative values are colours out of gamut.
    cube : bool
        Whether it is a map of six faces, stacked: +X, -X, +Y, -Y, +Z, -Z.
    """

    pixels: Float32
    converted: bool
    cube: bool


# ---------------------------------------------------------------------------------------------
# images


def read_image(path: PathName) -> Float32:
    """Read a linear OpenEXR or Radiance image; the content decides, not the extension.

    See `read_picture`.

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
    return read_picture(path).pixels


def read_picture(path: PathName) -> Picture:
    """Read a linear OpenEXR or Radiance image, and what it says about itself.

    OpenEXR: the channels R, G, B (or Y alone, repeated) of the first part that has them, of any
    type; the display window, black where it has no data. Radiance: scanlines of all kinds and
    orientations, with exposure and colour correction divided out. Other primaries than Rec.709's
    are converted: by way of CIE XYZ, unchanged in OpenEXR files, and scaled so that white stays
    white (von Kries, in Bradford's space) in Radiance's, as each format demands.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    FileNotFoundError
    FormatError
        As `read_image`.
    """
    with open_binary(path) as file:
        start = file.read(4)
        if start.startswith(b"#?"):
            found = decode_radiance(path, start + file.read())
            return _converted(path, found.pixels, found.primaries, False, keep_white=True)
    if start == MAGIC:
        stored = read_exr(path)
        return _converted(path, stored.pixels, stored.chromaticities, stored.cube)
    for beginning, name in _PICTURES.items():
        if start.startswith(beginning):
            raise FormatError(
                path,
                "linear light, an OpenEXR or Radiance image",
                f"a {name} picture, which holds display values: decode it by PIL.Image.open and "
                "traitbrdf.formats.display.decode_srgb, and give the array to EnvironmentMap; or "
                "let the program that made it write OpenEXR",
            )
    got = f"a file that starts with {start!r}" if start else "an empty file"
    raise FormatError(path, "an OpenEXR or Radiance image", got)


def _converted(
    path: PathName,
    pixels: Float32,
    primaries: tuple[float, ...] | None,
    cube: bool,
    keep_white: bool = False,
) -> Picture:
    if primaries is None or np.allclose(primaries, _REC709, atol=2e-3):
        return Picture(pixels, False, cube)
    try:
        matrix = _to_rec709(primaries, keep_white)
    except (np.linalg.LinAlgError, ZeroDivisionError, FloatingPointError):
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise FormatError(path, "chromaticities of three colours and white", str(primaries))
    return Picture(np.asarray(pixels @ matrix.T, np.float32), True, cube)


def _to_xyz(primaries: tuple[float, ...]) -> Float64:
    """Return the matrix (3, 3) from RGB to CIE XYZ, Y of white 1 (SMPTE RP 177, 1993)."""
    xy = np.array(primaries, np.float64).reshape(4, 2)
    xyz = np.concatenate([xy.T, 1.0 - xy.sum(axis=1)[None]])
    return np.asarray(xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / xyz[1, 3]))


def _to_rec709(primaries: tuple[float, ...], keep_white: bool) -> Float64:
    """Return the matrix (3, 3) from RGB of other primaries to Rec.709."""
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        source, target = _to_xyz(primaries), _to_xyz(_REC709)
        if keep_white:
            cone = np.array(
                [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
            )
            ratio = (cone @ target.sum(axis=1)) / (cone @ source.sum(axis=1))
            source = np.linalg.solve(cone, ratio[:, None] * (cone @ source))
        return np.asarray(np.linalg.solve(target, source))


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


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """Return a PNG file (H, W, 3 or 4) of bytes, as other files contain them.

    Parameters
    ----------
    pixels : (H, W, 3) or (H, W, 4) uint8
    """
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()
