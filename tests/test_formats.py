"""Files: round trips, every way a file can be wrong, and writing whole or not at all."""

from __future__ import annotations

import copy
import math
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import conftest
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from traitbrdf.formats.brdfs import read_merl, read_rgl, write_merl
from traitbrdf.formats.display import encode_srgb
from traitbrdf.formats.files import FormatError, atomic_path, stem
from traitbrdf.formats.images import read_image, write_exr, write_png


def image(height: int = 40, width: int = 17, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(0.0, 3.0, (height, width, 3))).astype(np.float32)


def left_behind(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# -- the shared folder ------------------------------------------------------------------------


def test_missing_shared_data_skips_here_and_fails_in_ci(monkeypatch, tmp_path):
    monkeypatch.setenv("TRAITBRDF_SHARED", str(tmp_path / "nowhere"))
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="nowhere"):
        conftest.find_shared_data()
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="nowhere"):
        conftest.find_shared_data()


# -- errors and atomic writing ----------------------------------------------------------------


def test_format_error_names_path_expected_and_got():
    error = FormatError("a/b.exr", "an image", "a cat")
    assert str(error) == "a/b.exr: expected an image, got a cat"
    assert isinstance(error, ValueError)
    assert str(copy.copy(error)) == str(error)


def test_stem():
    assert stem("folder/gold.binary") == "gold"
    assert stem(Path("x.y.bsdf")) == "x.y"


def test_atomic_path_replaces_the_file(tmp_path):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with atomic_path(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".bin"
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert left_behind(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt, GeneratorExit])
def test_atomic_path_keeps_the_old_file_on_failure(tmp_path, error):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(error), atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        raise error("stop")
    assert target.read_bytes() == b"old"
    assert left_behind(tmp_path) == ["a.bin"]


def test_atomic_path_keeps_the_old_file_if_the_replacement_fails(tmp_path, monkeypatch):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("traitbrdf.formats.files.os.fsync", full)
    with (
        pytest.raises(OSError, match="disk full"),
        atomic_path(target) as temporary,
    ):
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"old"
    assert left_behind(tmp_path) == ["a.bin"]


def test_atomic_path_follows_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "real" / "a.txt")
    with atomic_path(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"


def test_atomic_path_refuses_wrong_places(tmp_path):
    with (
        pytest.raises(FileNotFoundError, match="missing"),
        atomic_path(tmp_path / "missing" / "a.exr"),
    ):
        pass
    with pytest.raises(IsADirectoryError), atomic_path(tmp_path):
        pass
    with pytest.raises(FileNotFoundError, match="nothing"), atomic_path(tmp_path / "a"):
        pass
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.exr", lambda path: write_exr(path, image())),
        ("a.png", lambda path: write_png(path, np.zeros((4, 5, 3), np.uint8))),
        ("a.binary", lambda path: write_merl(path, np.ones((2, 3, 4, 3)))),
    ],
)
def test_a_writer_that_fails_half_way_leaves_the_old_file(tmp_path, monkeypatch, name, write):
    target = tmp_path / name
    target.write_bytes(b"old")

    def interrupted(path: Path, *_: object) -> None:
        assert path.exists()  # the new content is complete but not yet in place
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write(target)
    assert target.read_bytes() == b"old"
    assert left_behind(tmp_path) == [name]
    write(target)
    assert target.read_bytes() != b"old"
    assert left_behind(tmp_path) == [name]


@pytest.mark.parametrize("read", [read_image, read_merl, read_rgl])
def test_missing_and_foreign_files(tmp_path, read):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read(tmp_path / "nowhere.exr")
    for name, content in (("empty", b""), ("text", b"hello, world\n" * 9), ("zip", b"PK\3\4")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FormatError, match=rf"{name}: expected .+, got .+"):
            read(tmp_path / name)
        with pytest.raises(FormatError):
            read(str(tmp_path / name))


# -- OpenEXR ----------------------------------------------------------------------------------


def test_exr_float_round_trip_is_exact(tmp_path):
    pixels = image()
    pixels[0, 0] = -1.5, np.inf, np.nan
    write_exr(tmp_path / "a.exr", pixels)
    back = read_image(tmp_path / "a.exr")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, pixels)


def test_exr_half_round_trip_within_its_rounding(tmp_path):
    pixels = np.clip(image(), 1e-3, 6e4)
    write_exr(str(tmp_path / "a.exr"), pixels, half=True)
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), pixels, rtol=2**-11)


def test_exr_content_decides_not_the_extension(tmp_path):
    write_exr(tmp_path / "a.exr", image())
    (tmp_path / "a.exr").rename(tmp_path / "a.hdr")
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), image())


@pytest.mark.parametrize(("half", "value"), [(True, 7e4), (True, -65520.0), (False, 1e39)])
def test_exr_refuses_what_the_precision_cannot_hold(tmp_path, half, value):
    pixels = np.full((2, 2, 3), value)
    with pytest.raises(ValueError, match="expected values below"):
        write_exr(tmp_path / "a.exr", pixels, half=half)
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize(
    "wrong", [np.zeros((4, 4)), np.zeros((4, 4, 4)), np.zeros((0, 4, 3)), np.zeros((4, 4, 3), "c8")]
)
def test_exr_refuses_other_shapes_and_types(tmp_path, wrong):
    with pytest.raises(ValueError, match="expected"):
        write_exr(tmp_path / "a.exr", wrong)


def write_channels(path: Path, channels: dict[str, Any], **header: Any) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def test_exr_alpha_is_dropped_and_grey_repeated(tmp_path):
    pixels = image()
    rgba = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    write_channels(tmp_path / "rgba.exr", {"RGBA": rgba})
    np.testing.assert_array_equal(read_image(tmp_path / "rgba.exr"), pixels)
    grey = np.ascontiguousarray(pixels[..., 0])
    write_channels(tmp_path / "grey.exr", {"Y": grey, "A": grey})
    np.testing.assert_array_equal(
        read_image(tmp_path / "grey.exr"), np.repeat(grey[..., None], 3, axis=-1)
    )


def test_exr_without_colour_is_refused(tmp_path):
    plane = np.ascontiguousarray(image()[..., 0])
    for names, shown in ((["Z"], "Z"), (["R", "G"], "G, R"), (["Y", "RY", "BY"], "BY, RY, Y")):
        write_channels(tmp_path / "a.exr", dict.fromkeys(names, plane))
        with pytest.raises(FormatError, match=f"got channels {shown}$"):
            read_image(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "compression",
    ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"],
)
def test_exr_compressions(tmp_path, compression):
    pixels = np.clip(image(70, 33), 0.01, 100.0).astype(np.float16)
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    write_channels(tmp_path / "a.exr", {"RGB": pixels}, compression=kind)
    assert read_image(tmp_path / "a.exr").shape == (70, 33, 3)
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data[:-1])
    with pytest.raises(FormatError, match="cut within pixels"):
        read_image(tmp_path / "a.exr")


def test_exr_truncated_anywhere_is_refused_silently(tmp_path, capfd):
    write_exr(tmp_path / "whole.exr", image())
    data = (tmp_path / "whole.exr").read_bytes()
    for count in (1, 4, 6, 9, 30, 100, 300, 340, 400, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.exr").write_bytes(data[:count])
        with pytest.raises(FormatError, match=r"cut\.exr: expected"):
            read_image(tmp_path / "cut.exr")
    assert capfd.readouterr() == ("", "")


def test_exr_damaged_pixels_are_refused(tmp_path, capsys):
    smooth = np.linspace(0, 1, 40 * 17 * 3).reshape(40, 17, 3)  # noise would be stored uncompressed
    write_exr(tmp_path / "a.exr", smooth)
    data = bytearray((tmp_path / "a.exr").read_bytes())
    (offset,) = struct.unpack_from("<Q", data, data.index(b"scanlineimage\0") + 14)
    assert struct.unpack_from("<i", data, offset) == (0,)  # the first chunk: row, size, pixels
    data[offset + 8 : offset + 60] = b"\xff" * 52
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(FormatError, match="expected a readable OpenEXR image"):
        read_image(tmp_path / "a.exr")
    assert capsys.readouterr().out == ""


def test_exr_absurd_headers_are_refused_without_allocating(tmp_path):
    write_exr(tmp_path / "a.exr", image())
    data = (tmp_path / "a.exr").read_bytes()
    window = data.index(b"dataWindow\0box2i\0") + 17 + 4
    for corners in ((0, 0, 2**31 - 2, 2**31 - 2), (0, 0, -5, 10), (0, 0, 16, 10**6)):
        changed = data[:window] + struct.pack("<4i", *corners) + data[window + 16 :]
        (tmp_path / "b.exr").write_bytes(changed)
        assert_refused_cheaply(read_image, tmp_path / "b.exr")
    for position, value in ((4, 3), (5, 8), (window - 4, 255)):  # version, deep data, length
        changed = bytearray(data)
        changed[position] = value
        (tmp_path / "b.exr").write_bytes(changed)
        assert_refused_cheaply(read_image, tmp_path / "b.exr")
    nameless = data.replace(b"dataWindow", b"dataWindoW")
    (tmp_path / "b.exr").write_bytes(nameless)
    with pytest.raises(FormatError, match="dataWindow"):
        read_image(tmp_path / "b.exr")
    (tmp_path / "b.exr").write_bytes(data[:8] + b"x" * 600)
    with pytest.raises(FormatError, match="without an end"):
        read_image(tmp_path / "b.exr")


def assert_refused_cheaply(read: Callable[[Path], object], path: Path) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match="expected"):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()


def test_real_maps_read(shared_data):
    paths = sorted((shared_data / "envmaps").glob("*.exr"))
    assert len(paths) >= 8
    for path in paths:
        pixels = read_image(path)
        assert pixels.shape == (256, 512, 3)
        assert pixels.dtype == np.float32
        assert np.isfinite(pixels).all()
        assert 0.01 < pixels.mean() < 10.0


# -- Radiance ---------------------------------------------------------------------------------


def rgbe(height: int, width: int, seed: int = 1) -> np.ndarray:
    """Random pixels with runs, none of which looks like a marker."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(128, 256, (height, width, 4)).astype(np.uint8)
    pixels[..., 3] = rng.integers(120, 140, (height, width))
    pixels[:, width // 3 : width // 2] = pixels[:, width // 3 : width // 3 + 1]
    pixels[0, 0, 3] = 0
    return pixels


def decoded(pixels: np.ndarray) -> np.ndarray:
    exponent = pixels[..., 3:].astype(np.float64)
    return np.where(exponent > 0, pixels[..., :3] * 2.0 ** (exponent - 136.0), 0.0)


def new_style(pixels: np.ndarray) -> bytes:
    """Run-length encode each channel of each scanline."""
    width = pixels.shape[1]
    out = b""
    for row in pixels:
        out += bytes((2, 2, width >> 8, width & 255))
        for channel in row.T:
            x = 0
            while x < width:
                run = 1
                while x + run < width and run < 127 and channel[x + run] == channel[x]:
                    run += 1
                if run > 2:
                    out += bytes((128 + run, channel[x]))
                    x += run
                else:
                    piece = channel[x : x + 5]
                    out += bytes((len(piece),)) + piece.tobytes()
                    x += len(piece)
    return out


def radiance(
    body: bytes, size: str, header: str = "#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n"
) -> bytes:
    return f"{header}\n{size}\n".encode() + body


@pytest.mark.parametrize("style", ["flat", "new", "old"])
def test_radiance_scanlines(tmp_path, style):
    pixels = rgbe(7, 300)
    if style == "old":  # 299 = 43 + 256 repetitions of the first pixel of each row
        pixels[:] = pixels[:, 1:2]
        body = b"".join(row[0].tobytes() + bytes((1, 1, 1, 43, 1, 1, 1, 1)) for row in pixels)
    else:
        body = new_style(pixels) if style == "new" else pixels.tobytes()
    (tmp_path / "a.hdr").write_bytes(radiance(body, "-Y 7 +X 300"))
    result = read_image(tmp_path / "a.hdr")
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, decoded(pixels).astype(np.float32))


def test_radiance_orientation_and_exposure(tmp_path):
    pixels = rgbe(5, 6)
    expected = decoded(pixels)
    header = "#?RGBE\nEXPOSURE=2\nFORMAT=32-bit_rle_rgbe\nEXPOSURE= 2.0\n"
    for size, view in (
        ("-Y 5 +X 6", expected),
        ("+Y 5 +X 6", expected[::-1]),
        ("-Y 5 -X 6", expected[:, ::-1]),
    ):
        (tmp_path / "a.pic").write_bytes(radiance(pixels.tobytes(), size, header))
        np.testing.assert_allclose(read_image(tmp_path / "a.pic"), view / 4, rtol=1e-7)


@pytest.mark.parametrize("style", ["flat", "new"])
def test_radiance_truncated_anywhere(tmp_path, style):
    pixels = rgbe(4, 40)
    body = new_style(pixels) if style == "new" else pixels.tobytes()
    data = radiance(body, "-Y 4 +X 40")
    for count in (
        3,
        12,
        30,
        len(data) - len(body) - 3,
        len(data) - len(body) + 2,
        len(data) - 50,
        len(data) - 1,
    ):
        (tmp_path / "cut.hdr").write_bytes(data[:count])
        with pytest.raises(FormatError, match=r"cut\.hdr: expected"):
            read_image(tmp_path / "cut.hdr")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (radiance(b"", "-Y 4 +X 4", "#?RADIANCE\nFORMAT=32-bit_rle_xyze\n"), "xyze"),
        (radiance(b"", "-Y 4 +X 4", "#?RADIANCE\nEXPOSURE=zero\n"), "EXPOSURE"),
        (radiance(b"", "-Y 4 +X 4", "#?RADIANCE\nEXPOSURE=0\n"), "EXPOSURE"),
        (radiance(b"", "+X 4 -X 4"), "resolution line"),
        (radiance(b"", "-Y 4 +X 4", "#?RADIANCE\nCOLORCORR=1 0 1\n"), "COLORCORR"),
        (radiance(b"", "-Y 4 +X 4", "#?RADIANCE\nPRIMARIES=1 0 1\n"), "PRIMARIES"),
        (radiance(b"", "-Y four +X 4"), "resolution line"),
        (radiance(b"", "-Y 0 +X 4"), "pixels"),
        (radiance(b"", "-Y 99999 +X 99999"), "pixels"),
        (radiance(b"", "-Y 8192 +X 16384"), "in row 0|complete"),
        (radiance(bytes((2, 2, 0, 20, 0)), "-Y 1 +X 20"), "a run of 0"),
        (radiance(bytes((2, 2, 0, 20, 255, 7)), "-Y 1 +X 20"), "a run of 127"),
        (radiance(bytes((1, 1, 1, 9)) * 9, "-Y 1 +X 6"), "a run of 9"),
    ],
)
def test_radiance_wrong_headers_and_runs(tmp_path, data, message):
    (tmp_path / "a.hdr").write_bytes(data)
    with pytest.raises(FormatError, match=message):
        read_image(tmp_path / "a.hdr")
    assert_refused_cheaply(read_image, tmp_path / "a.hdr")


# -- PNG and sRGB -----------------------------------------------------------------------------


def test_png_round_trip(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (9, 13, 3)).astype(np.uint8)
    write_png(tmp_path / "a.png", pixels)
    with Image.open(tmp_path / "a.png") as back:
        assert back.format == "PNG"
        np.testing.assert_array_equal(np.asarray(back), pixels)


def test_png_refuses_other_types_and_shapes(tmp_path):
    for wrong in (np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)):
        with pytest.raises(ValueError, match="expected"):
            write_png(tmp_path / "a.png", wrong)
    assert left_behind(tmp_path) == []


def test_srgb_is_exact_and_clips():
    codes = np.arange(256) / 255.0  # decoded by the inverse of the standard's formula
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    for dtype in (np.float32, np.float64):
        encoded = encode_srgb(np.repeat(linear[:, None], 3, axis=1).astype(dtype))
        assert encoded.dtype == np.uint8
        np.testing.assert_array_equal(encoded[:, 0], np.arange(256))
    np.testing.assert_array_equal(
        encode_srgb([[-1.0, 2.0, np.inf], [-np.inf, 0.0, 0.18]]),
        [[0, 255, 255], [0, 0, 118]],
    )


def test_srgb_refuses_nan_and_other_shapes():
    with pytest.raises(ValueError, match="got 1 NaN"):
        encode_srgb([0.0, np.nan, 1.0])
    with pytest.raises(ValueError, match="shape"):
        encode_srgb(np.zeros((3, 4)))
    with pytest.raises(ValueError, match="real numbers"):
        encode_srgb(["a", "b", "c"])


# -- MERL -------------------------------------------------------------------------------------


def test_merl_round_trip_and_layout(tmp_path):
    values = np.random.default_rng(0).random((4, 3, 5, 3)) * 100.0
    values[1, 2, 3] = -1.0  # invalid cells do not change
    path = tmp_path / "a.binary"
    write_merl(path, values)
    np.testing.assert_allclose(read_merl(path), values, rtol=4e-16)
    data = path.read_bytes()
    assert len(data) == 12 + 24 * 60
    assert struct.unpack("<3i", data[:12]) == (4, 3, 5)
    planes = np.frombuffer(data[12:], "<f8")
    index = 2 + 5 * (1 + 3 * 3)  # theta_h 3, theta_d 1, phi_d 2
    scales = 1 / 1500, 1.15 / 1500, 1.66 / 1500
    for channel, scale in enumerate(scales):
        assert planes[60 * channel + index] * scale == pytest.approx(values[3, 1, 2, channel])


def test_merl_full_size(tmp_path):
    values = np.random.default_rng(0).random((90, 90, 180, 3))
    write_merl(tmp_path / "a.binary", values.astype(np.float32))
    assert (tmp_path / "a.binary").stat().st_size == 34_992_012
    back = read_merl(tmp_path / "a.binary")
    np.testing.assert_allclose(back, values.astype(np.float32), rtol=4e-16)


@pytest.mark.parametrize(
    "dims", [(0, 3, 4), (-90, -90, 180), (2, 3, 5), (2**31 - 1,) * 3, (90, 90, 180)]
)
def test_merl_headers_that_lie(tmp_path, dims):
    path = tmp_path / "a.binary"
    write_merl(path, np.ones((2, 3, 4, 3)))
    path.write_bytes(struct.pack("<3i", *dims) + path.read_bytes()[12:])
    with pytest.raises(FormatError, match=r"expected a MERL file.+got 588 bytes"):
        read_merl(path)
    assert_refused_cheaply(read_merl, path)


def test_merl_truncated_or_too_long(tmp_path):
    path = tmp_path / "a.binary"
    write_merl(path, np.ones((2, 3, 4, 3)))
    data = path.read_bytes()
    for changed in (data[:5], data[:12], data[:200], data[:-1], data + b"\0"):
        path.write_bytes(changed)
        with pytest.raises(FormatError, match=r"a.binary: expected"):
            read_merl(path)
    path.write_bytes(data[:-8] + struct.pack("<d", math.nan))
    with pytest.raises(FormatError, match="23 in colour 2"):
        read_merl(path)


def test_merl_refuses_to_write_other_values(tmp_path):
    for wrong in (np.ones((2, 3, 4)), np.ones((0, 3, 4, 3)), np.full((2, 2, 2, 3), np.nan)):
        with pytest.raises(ValueError, match="expected"):
            write_merl(tmp_path / "a.binary", wrong)
    assert left_behind(tmp_path) == []


# -- RGL --------------------------------------------------------------------------------------


def test_rgl_reads_what_was_written(tmp_path, tensor_writer, rgl_fields):
    rgl_fields["jacobian"] = np.ones(1, np.uint8)
    fields = read_rgl(tensor_writer(tmp_path / "a.bsdf", rgl_fields))
    for name in ("phi_i", "theta_i", "sigma", "ndf", "vndf", "luminance", "rgb"):
        np.testing.assert_array_equal(getattr(fields, name), rgl_fields[name])
    assert fields.jacobian is True
    assert fields.description == "a test material"


def test_rgl_truncated_anywhere(tmp_path, tensor_writer, rgl_fields):
    path = tensor_writer(tmp_path / "a.bsdf", rgl_fields)
    data = path.read_bytes()
    for count in (5, 12, 14, 18, 19, 25, 60, 200, 400, 1000, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:count])
        with pytest.raises(FormatError, match=r"a.bsdf: expected"):
            read_rgl(path)


def test_rgl_wrong_magic_and_version(tmp_path, tensor_writer, rgl_fields):
    path = tensor_writer(tmp_path / "a.bsdf", rgl_fields)
    data = path.read_bytes()
    for position, message in ((0, "starts with"), (12, "version 9.0"), (13, "version 1.9")):
        changed = bytearray(data)
        changed[position] = 9
        path.write_bytes(changed)
        with pytest.raises(FormatError, match=message):
            read_rgl(path)


def test_rgl_absurd_tables_are_refused_without_allocating(tmp_path, tensor_writer, rgl_fields):
    path = tensor_writer(tmp_path / "a.bsdf", rgl_fields)
    data = path.read_bytes()
    rgb = data.index(b"\3\0rgb") + 5  # rank, type, offset, shape follow
    for position, value in (
        (rgb, struct.pack("<H", 60000)),
        (rgb + 2, b"\x40"),
        (rgb + 2, b"\0"),
        (rgb + 3, struct.pack("<Q", 2**64 - 8)),
        (rgb + 11, struct.pack("<Q", 2**63)),
        (rgb + 11 + 8, struct.pack("<2Q", 2**32, 2**32)),  # the product wraps to 0 in 64 bits
        (14, struct.pack("<I", 2**32 - 1)),
    ):
        path.write_bytes(data[:position] + value + data[position + len(value) :])
        assert_refused_cheaply(read_rgl, path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rgb", None, "a field 'rgb'"),
        ("vndf", np.ones((1, 46, 8, 8)), "vndf as <f4"),
        ("vndf", np.ones((1, 45, 8, 8), "f4"), "vndf of 1 azimuths, 46 elevations"),
        ("vndf", np.zeros((1, 46, 8, 8), "f4"), "density"),
        ("vndf", np.ones((46, 8, 8), "f4"), "vndf as <f4 with 4 axes"),
        ("rgb", np.ones((1, 46, 4, 96, 96), "f4"), "rgb of"),
        ("rgb", np.ones((1, 46, 3, 32, 32), "f4"), "rgb of"),
        ("ndf", np.ones((1, 4), "f4"), "at least 2 x 2"),
        ("ndf", -np.ones((2, 4), "f4"), "sigma and ndf"),
        ("sigma", np.zeros((2, 4), "f4"), "positive sigma"),
        ("sigma", np.full((2, 4), np.nan, "f4"), "finite"),
        ("sigma", np.ones((0, 4), "f4"), "sigma as"),
        ("theta_i", np.zeros(46, "f4"), "increasing theta_i"),
        ("jacobian", np.zeros(1, "f4"), "jacobian as u1"),
    ],
)
def test_rgl_fields_that_do_not_fit(tmp_path, tensor_writer, rgl_fields, name, value, message):
    if value is None:
        del rgl_fields[name]
    else:
        rgl_fields[name] = value
    with pytest.raises(FormatError, match=message):
        read_rgl(tensor_writer(tmp_path / "a.bsdf", rgl_fields))


def test_rgl_real_files(shared_data):
    paths = sorted((shared_data / "rgl").glob("*.bsdf"))
    assert len(paths) >= 8
    for path in paths:
        fields = read_rgl(path)
        assert fields.phi_i.shape == (1,)
        assert fields.rgb.shape == (1, 8, 3, 32, 32)
        assert fields.jacobian
        assert fields.description
        assert fields.theta_i[-1] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("kind", ["exr", "hdr", "binary", "bsdf"])
def test_damaged_bytes_end_in_format_error(tmp_path, tensor_writer, rgl_fields, kind):
    """A randomly damaged file can still be read, or is refused with an error that names it."""
    path = tmp_path / f"a.{kind}"
    read: Callable[[Path], object] = read_image
    if kind == "exr":
        write_exr(path, image(12, 9))
    elif kind == "hdr":
        path.write_bytes(radiance(new_style(rgbe(4, 40)), "-Y 4 +X 40"))
    elif kind == "binary":
        write_merl(path, np.ones((2, 3, 4, 3)))
        read = read_merl
    else:
        tensor_writer(path, rgl_fields)
        read = read_rgl
    data = path.read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(80):
        changed = bytearray(data[: rng.integers(1, len(data)) if rng.random() < 0.3 else None])
        for position in rng.integers(0, min(len(changed), 500), 2):
            changed[position] = rng.integers(256)
        path.write_bytes(changed)
        try:
            read(path)
        except FormatError:
            refused += 1
    assert refused > 20
