"""Maps and pictures as other programs write them: windows, colours, parts, layouts, threads."""

from __future__ import annotations

import io
import math
import struct
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import traitbrdf as tb
from traitbrdf.directions import latlong_to_direction
from traitbrdf.formats.files import FormatError
from traitbrdf.formats.images import read_image, read_picture, write_exr

REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
FROM_2020 = np.array(  # ITU-R BT.2087-0, table 2 inverted
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
FROM_XYZ = np.array(  # IEC 61966-2-1
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)


def pixels(height: int = 6, width: int = 12, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 4.0, (height, width, 3)).astype(np.float32)


def write(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    plain = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File({**plain, **header}, channels) as file:
        file.write(str(path))
    return path


def window(x0: int, y0: int, x1: int, y1: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


# -- OpenEXR --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "display"),
    [
        ((0, 0, 11, 5), (0, 0, 11, 5)),
        ((2, 1, 13, 6), (0, 0, 15, 7)),  # black around the data
        ((-3, -2, 8, 3), (0, 0, 11, 5)),  # overscan at two sides
        ((-2, -2, 9, 3), (1, -1, 4, 2)),  # a crop
        ((100, 50, 111, 55), (98, 50, 111, 55)),
        ((20, 20, 31, 25), (0, 0, 3, 1)),  # apart: nothing is shown
    ],
)
def test_the_display_window_is_the_image(tmp_path, data, display):
    stored = pixels()
    path = write(
        tmp_path / "a.exr",
        {"RGB": stored},
        dataWindow=window(*data),
        displayWindow=window(*display),
    )
    shown = read_image(path)
    assert shown.shape == (display[3] - display[1] + 1, display[2] - display[0] + 1, 3)
    for y in range(shown.shape[0]):
        for x in range(shown.shape[1]):
            row, column = y + display[1] - data[1], x + display[0] - data[0]
            inside = 0 <= row < 6 and 0 <= column < 12
            expected = stored[row, column] if inside else np.zeros(3)
            np.testing.assert_array_equal(shown[y, x], expected)


@pytest.mark.parametrize(("primaries", "matrix"), [(REC2020, FROM_2020), (XYZ, FROM_XYZ)])
def test_chromaticities_are_converted(tmp_path, primaries, matrix):
    stored = pixels()
    path = write(tmp_path / "a.exr", {"RGB": stored}, chromaticities=primaries)
    found = read_picture(path)
    assert found.converted
    np.testing.assert_allclose(found.pixels, stored @ matrix.T, atol=2e-3 * stored.max())


def test_white_of_other_primaries_is_kept_where_it_is_the_same(tmp_path):
    path = write(
        tmp_path / "a.exr", {"RGB": np.ones((2, 4, 3), np.float32)}, chromaticities=REC2020
    )
    np.testing.assert_allclose(read_image(path), 1.0, atol=1e-5)
    environment = tb.EnvironmentMap.read(path)
    np.testing.assert_allclose(environment.image, 1.0, atol=1e-5)


def test_colours_out_of_gamut_are_set_to_zero_and_counted(tmp_path):
    green = np.zeros((2, 4, 3), np.float32)
    green[0, :, 1] = 1.0
    path = write(tmp_path / "a.exr", {"RGB": green}, chromaticities=REC2020)
    environment = tb.EnvironmentMap.read(path)
    assert environment.clipped_texels == 4
    np.testing.assert_allclose(environment.image[0, 0], [0.0, 1.1329, 0.0], atol=1e-3)


def test_rec709_written_out_changes_no_bit(tmp_path):
    rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
    path = write(tmp_path / "a.exr", {"RGB": pixels()}, chromaticities=rec709)
    np.testing.assert_array_equal(read_image(path), pixels())


@pytest.mark.parametrize("bad", [(0.0,) * 8, (0.3, 0.3) * 4, (math.nan,) * 8])
def test_chromaticities_that_are_none(tmp_path, bad):
    path = write(tmp_path / "a.exr", {"RGB": pixels()}, chromaticities=bad)
    with pytest.raises(FormatError, match="chromaticities of three colours"):
        read_image(path)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint32])
@pytest.mark.parametrize("names", ["RGB", "Y"])
def test_channels_of_any_type(tmp_path, kind, names):
    planes = np.random.default_rng(1).integers(0, 50, (len(names), 4, 8)).astype(kind)
    path = write(tmp_path / "a.exr", dict(zip(names, planes, strict=True)))
    expected = np.stack([*planes] * (3 // len(names)), axis=-1)
    np.testing.assert_array_equal(read_image(path), expected.astype(np.float32))


def test_channels_of_several_types(tmp_path):
    red, green, blue = (np.full((2, 4), i + 1) for i in range(3))
    channels = {"R": red.astype(np.float16), "G": green.astype(np.uint32),
                "B": blue.astype(np.float32), "A": red.astype(np.float16)}  # fmt: skip
    np.testing.assert_array_equal(read_image(write(tmp_path / "a.exr", channels))[0, 0], [1, 2, 3])


def test_layers(tmp_path):
    plane = np.ones((2, 4), np.float32)
    one = {f"beauty.{c}": (i + 1) * plane for i, c in enumerate("RGB")}
    np.testing.assert_array_equal(read_image(write(tmp_path / "a.exr", one))[0, 0], [1, 2, 3])
    two = {**one, **{f"diffuse.{c}": plane for c in "RGB"}}
    with pytest.raises(FormatError, match="of one layer, got layers beauty, diffuse"):
        read_image(write(tmp_path / "b.exr", two))
    both = {**two, **dict.fromkeys("RGB", 5 * plane)}
    np.testing.assert_array_equal(read_image(write(tmp_path / "c.exr", both))[0, 0], [5, 5, 5])


def test_the_first_part_with_colours(tmp_path):
    depth = np.ones((6, 12), np.float32)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, channels, name)
        for name, channels in (
            ("depth", {"Z": depth}),
            ("beauty", {"RGB": pixels()}),
            ("other", {"RGB": 9 * pixels()}),
        )
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), pixels())


def test_tiles(tmp_path):
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    path = write(tmp_path / "a.exr", {"RGB": pixels(40, 50)}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(read_image(path), pixels(40, 50))


@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PIZ", "RLE", "PXR24", "DWAB"])
def test_compressions_keep_pixels(tmp_path, compression):
    ramp = np.repeat(np.linspace(0.5, 1.5, 200, dtype=np.float32)[None, :, None], 70, axis=0)
    stored = np.ascontiguousarray(np.broadcast_to(ramp, (70, 200, 3)).astype(np.float16))
    path = write(
        tmp_path / "a.exr",
        {"RGB": stored},
        compression=getattr(OpenEXR, f"{compression}_COMPRESSION"),
    )
    exact = compression not in ("DWAB",)
    np.testing.assert_allclose(read_image(path), stored, rtol=0.0 if exact else 0.02)


def test_luminance_with_chroma_is_refused(tmp_path):
    plane = np.ones((4, 4), np.float32)
    with pytest.raises(FormatError, match="got channels BY, RY, Y"):
        read_image(write(tmp_path / "a.exr", {"Y": plane, "RY": plane, "BY": plane}))


def oriented(direction: np.ndarray) -> np.ndarray:
    """A smooth colour for each direction."""
    return (1.0 + 0.5 * direction + 0.2 * direction[..., ::-1] ** 2).astype(np.float32)


def test_cube_maps_are_converted(tmp_path):
    """The faces are drawn as ImfEnvmap.h describes them, in OpenEXR's own directions."""
    size = 64
    t = np.linspace(-1.0, 1.0, size)  # centres of border pixels lie on the edges
    x, y = np.meshgrid(t, t, indexing="xy")
    one = np.ones_like(x)
    faces = [
        (one, -y, x), (-one, -y, -x),  # +X: right is +z, down is -y
        (x, one, -y), (x, -one, y),
        (-x, -y, one), (x, -y, -one),
    ]  # fmt: skip
    directions = np.stack([np.stack(f, axis=-1) for f in faces])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    cube = oriented(directions).reshape(6 * size, size, 3)
    path = write(tmp_path / "cube.exr", {"RGB": cube}, envmap=OpenEXR.ENVMAP_CUBE)
    found = tb.EnvironmentMap.read(path).image
    v, u = np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(256) + 0.5) / 256, indexing="ij")
    ours = latlong_to_direction(u, v)
    theirs = ours * [-1.0, 1.0, -1.0]  # +z in the middle of the lat-long map, +x to its left
    np.testing.assert_allclose(found, oriented(theirs), atol=2e-3)
    with pytest.raises(FormatError, match="six faces"):
        tb.EnvironmentMap.read(
            write(tmp_path / "b.exr", {"RGB": cube[:-1]}, envmap=OpenEXR.ENVMAP_CUBE)
        )


# -- Radiance -------------------------------------------------------------------------------------


def radiance(lines: list[str], size: str, rgbe: np.ndarray) -> bytes:
    head = "\n".join(["#?RADIANCE", "FORMAT=32-bit_rle_rgbe", *lines, "", size, ""])
    return head.encode() + rgbe.tobytes()


def rgbe() -> np.ndarray:
    found = np.random.default_rng(2).integers(128, 250, (5, 6, 4)).astype(np.uint8)
    found[..., 3] = 129
    return found


VALUES = rgbe()[..., :3] * 2.0 ** (129 - 136)


@pytest.mark.parametrize(
    ("lines", "factor"),
    [
        ([], 1.0),
        (["EXPOSURE=4"], 0.25),
        (["EXPOSURE=4", "EXPOSURE= 0.5"], 0.5),
        (["\tEXPOSURE=4"], 1.0),  # of a picture that this one was made of
        ([" EXPOSURE=4"], 1.0),
        (["pfilt -e EXPOSURE=4"], 1.0),
        (["# EXPOSURE=4"], 1.0),
        (["COLORCORR=1 2 4"], [1.0, 0.5, 0.25]),
        (["COLORCORR=1 2 4", "EXPOSURE=2", "COLORCORR=2 1 1"], [0.25, 0.25, 0.125]),
        (["\tCOLORCORR=1 2 4"], 1.0),
        (["SOFTWARE=x", "VIEW=-vtl", "GAMMA=1", "PIXASPECT=1"], 1.0),
    ],
)
def test_exposure_and_colour_correction(tmp_path, lines, factor):
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance(lines, "-Y 5 +X 6", rgbe()))
    np.testing.assert_allclose(read_image(path), VALUES * np.array(factor), rtol=1e-6)


def test_primaries(tmp_path):
    path = tmp_path / "a.hdr"
    line = "PRIMARIES=" + " ".join(map(str, REC2020))
    path.write_bytes(radiance([line], "-Y 5 +X 6", rgbe()))
    np.testing.assert_allclose(read_image(path), VALUES @ FROM_2020.T, atol=3e-3 * VALUES.max())
    grey = rgbe()
    grey[..., :3] = 200
    own = "PRIMARIES= 0.640 0.330 0.290 0.600 0.150 0.060 0.3333 0.3333"  # Radiance's own
    path.write_bytes(radiance([own], "-Y 5 +X 6", grey))
    np.testing.assert_allclose(read_image(path), 200 * 2.0**-7, rtol=1e-4)  # white stays white


@pytest.mark.parametrize("down", ["-Y", "+Y"])
@pytest.mark.parametrize("right", ["+X", "-X"])
@pytest.mark.parametrize("columns", [False, True])
def test_all_orientations(tmp_path, down, right, columns):
    stored = rgbe()[:: 1 if down == "-Y" else -1, :: 1 if right == "+X" else -1]
    size = f"{down} 5 {right} 6"
    if columns:
        stored, size = np.swapaxes(stored, 0, 1), f"{right} 6 {down} 5"
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance([], size, np.ascontiguousarray(stored)))
    np.testing.assert_allclose(read_image(path), VALUES)


# -- what is no light -----------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["png", "jpg", "gif", "bmp", "tiff", "webp"])
def test_display_pictures_are_refused_with_how_to_do_it(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(np.full((4, 8, 3), 99, np.uint8)).save(path)
    with pytest.raises(FormatError, match=r"display values: decode it by .*decode_srgb"):
        tb.EnvironmentMap.read(path)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_integers_are_no_light(kind):
    with pytest.raises(TypeError, match=r"expected linear light as floats, got uint.*decode_srgb"):
        tb.EnvironmentMap(np.ones((2, 4, 3), kind))


@pytest.mark.parametrize("shape", [(8, 8), (6, 36), (5, 4), (9, 16)])
def test_other_shapes_need_a_layout(tmp_path, shape):
    path = tmp_path / "a.exr"
    write_exr(path, pixels(*shape))
    with pytest.raises(FormatError, match=r"twice as wide as high, or a named layout.*layout='ang"):
        tb.EnvironmentMap.read(path)
    assert tb.EnvironmentMap.read(path, layout="latlong").image.shape == (*shape, 3)


@pytest.mark.parametrize("shape", [(8, 16), (8, 15), (8, 17), (1, 2)])
def test_lat_long_maps_need_none(tmp_path, shape):
    path = tmp_path / "a.exr"
    write_exr(path, pixels(*shape))
    np.testing.assert_array_equal(tb.EnvironmentMap.read(path).image, pixels(*shape))


def test_infinite_texels_say_what_to_do(tmp_path):
    bright = pixels(4, 8)
    bright[1, 2] = np.inf
    write_exr(tmp_path / "a.exr", bright, half=True)
    with pytest.raises(FormatError, match=r"3 values that are not; half.*posinf=65504"):
        tb.EnvironmentMap.read(tmp_path / "a.exr")
    tb.EnvironmentMap(np.nan_to_num(read_image(tmp_path / "a.exr"), posinf=65504))


# -- threads, crashes and prints ------------------------------------------------------------------


def damaged(path: Path, compression: Any) -> Path:
    """An image whose first chunk is no valid stream."""
    smooth = np.linspace(0, 1, 40 * 17 * 3, dtype=np.float32).reshape(40, 17, 3)
    data = bytearray(write(path, {"RGB": smooth}, compression=compression).read_bytes())
    (offset,) = struct.unpack_from("<Q", data, data.index(b"scanlineimage\0") + 14)
    data[offset + 8 : offset + 40] = b"\xff" * 32
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("compression", [OpenEXR.ZIP_COMPRESSION, OpenEXR.PXR24_COMPRESSION])
def test_damaged_pixels_print_nothing(tmp_path, capfd, compression):
    path = damaged(tmp_path / "a.exr", compression)
    with pytest.raises(FormatError, match="expected a readable OpenEXR image"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


def test_threads_that_read_leave_the_output_alone(tmp_path):
    """Whatever stands in sys.stdout while images are read stays there, and gets what is printed."""
    good, bad = tmp_path / "good.exr", damaged(tmp_path / "bad.exr", OpenEXR.ZIP_COMPRESSION)
    write_exr(good, pixels())
    before, faults = sys.stdout, []

    def read() -> None:
        for _ in range(4):
            read_image(good)
            try:
                read_image(bad)
            except FormatError:
                continue
            faults.append("read")

    kept = io.StringIO()
    sys.stdout = kept
    try:
        threads = [threading.Thread(target=read) for _ in range(4)]
        for thread in threads:
            thread.start()
        for i in range(2000):
            print(i)
            if sys.stdout is not kept:
                faults.append("swapped")
        for thread in threads:
            thread.join()
        assert sys.stdout is kept
    finally:
        sys.stdout = before
    assert not faults
    assert kept.getvalue() == "".join(f"{i}\n" for i in range(2000))
