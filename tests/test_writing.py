"""Materials that leave: MERL, RGL and our own files look elsewhere as they do here."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

import traitbrdf as tb
from traitbrdf import reference
from traitbrdf.directions import half_diff_angles
from traitbrdf.formats.brdfs import MERL_SCALE, read_merl, write_merl
from traitbrdf.formats.files import FormatError
from traitbrdf.reflectance.brdf import albedo_of

NAMES = (
    "black-plastic", "white-plastic", "gold-polished", "aluminium-brushed", "iron-cast",
    "red-car-paint", "silver-paint", "white-porcelain", "red-rubber", "black-velvet",
    "red-phenolic", "blue-acrylic",
)  # fmt: skip
LIBRARY = tb.default_library()
ANGLES = np.radians([0.0, 30.0, 50.0, 65.0, 75.0, 80.0])


def pairs(count: int, least: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Directions whose cosines are above `least`."""
    rng = np.random.default_rng(seed)
    cosine, turn = rng.uniform(least, 1.0, (2, count)), rng.uniform(0, 2 * math.pi, (2, count))
    sine = np.sqrt(1.0 - cosine**2)
    w = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)
    return w[0], w[1]


# -- MERL -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_merl_files_have_the_albedo_of_the_table(tmp_path, name):
    """Bins that the horizon cuts were invalid: at 75 degrees 6 % of black plastic was missing."""
    path = tmp_path / "a.binary"
    LIBRARY[name].write(path)
    found, expected = tb.TabulatedBRDF.read(path).albedo(ANGLES), LIBRARY[name].albedo(ANGLES)
    np.testing.assert_allclose(found, expected, rtol=3e-3, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_merl_files_look_like_the_table(tmp_path, shared_data, name):
    environment = tb.EnvironmentMap.read(shared_data / "envmaps" / "studio.exr")
    small = environment.image.reshape(32, 8, 64, 8, 3).mean(axis=(1, 3))
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap(small), size=16)
    some = np.arange(3, len(scene.pixels), 16)
    LIBRARY[name].write(tmp_path / "a.binary")
    read = tb.TabulatedBRDF.read(tmp_path / "a.binary")
    shown, expected = (
        reference.fragments(scene, some, [brdf], 1e-3)[0] for brdf in (read, LIBRARY[name])
    )
    assert np.abs(shown - expected).mean() <= 3e-3 * expected.mean()


def test_merl_bytes_are_what_the_format_says(tmp_path):
    values = np.random.default_rng(0).lognormal(0.0, 3.0, (90, 90, 180, 3))
    write_merl(tmp_path / "a.binary", values)
    data = (tmp_path / "a.binary").read_bytes()
    assert len(data) == 34_992_012
    assert struct.unpack("<3i", data[:12]) == (90, 90, 180)
    stored = np.frombuffer(data, "<f8", offset=12).reshape(3, 90, 90, 180)
    for channel, scale in enumerate((1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)):
        np.testing.assert_allclose(stored[channel] * scale, values[..., channel], rtol=1e-15)
    write_merl(tmp_path / "b.binary", read_merl(tmp_path / "a.binary"))
    assert (tmp_path / "b.binary").read_bytes() == data


def test_merl_files_of_tables_are_written_alike_again(tmp_path):
    LIBRARY["gold-polished"].write(tmp_path / "a.binary")
    tb.TabulatedBRDF.read(tmp_path / "a.binary").write(tmp_path / "b.binary")
    assert (tmp_path / "a.binary").read_bytes() == (tmp_path / "b.binary").read_bytes()


def test_merl_bins_are_invalid_only_where_nobody_sees(tmp_path):
    LIBRARY["white-plastic"].write(tmp_path / "a.binary")
    values = read_merl(tmp_path / "a.binary")
    invalid = (values < 0.0).any(axis=-1)
    np.testing.assert_allclose(values[invalid], np.tile(-np.array(MERL_SCALE), (invalid.sum(), 1)))
    assert 0.1 < invalid.mean() < 0.3
    # every bin that a visible pair falls into, and the nodes around it
    wi, wo = pairs(200_000, 1e-6)
    grid = tb.HalfDiffGrid.merl()
    index, weight = grid.stencil(*half_diff_angles(wi, wo))
    assert not invalid.reshape(-1)[index[weight > 1e-9]].any()
    assert invalid.mean() > 0.9 * (1.0 - grid.above_horizon.mean())


# -- RGL ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES[::3])
def test_rgl_files_hold_the_table(tmp_path, name):
    table = LIBRARY[name]
    table.write(tmp_path / "a.bsdf")
    read = tb.MeasuredBRDF.read(tmp_path / "a.bsdf")
    wi, wo = pairs(20_000, 0.1)
    found, expected = read.eval(wi, wo), table.eval(wi, wo)
    off = np.abs(found - expected).mean(axis=1) / expected.mean(axis=1)
    assert np.median(off) <= 0.01
    assert np.percentile(off, 99) <= 0.05
    for angle in ANGLES:
        one, two = (albedo_of(brdf.eval, float(angle)).mean() for brdf in (read, table))
        assert one == pytest.approx(two, rel=5e-3)


def theirs(mitsuba, path, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f in 1/sr as Mitsuba's `measured` evaluates it: the mean of both orders, for one."""
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    context, si = mitsuba.BSDFContext(), mitsuba.SurfaceInteraction3f()
    found = np.empty((2, len(wi), 3))
    for order, (a, b) in enumerate(((wi, wo), (wo, wi))):
        for k in range(len(wi)):
            si.wi = mitsuba.Vector3f(a[k])
            value = np.array(bsdf.eval(context, si, mitsuba.Vector3f(b[k])))
            found[order, k] = np.maximum(value, 0.0) / b[k, 2]
    return found.mean(axis=0)


@pytest.fixture(scope="module")
def mitsuba():
    try:
        import mitsuba as found
    except ImportError:
        pytest.skip("needs the extra 'peers'")
    before = found.variant()
    found.set_variant("scalar_rgb")
    yield found
    if before:
        found.set_variant(before)


@pytest.mark.slow
def test_rgl_is_read_as_another_renderer_reads_it(shared_data, mitsuba):
    files = sorted((shared_data / "rgl").glob("*.bsdf"))
    assert len(files) == 8
    wi, wo = pairs(10_000, 0.1, seed=3)
    for path in files:
        ours = tb.MeasuredBRDF.read(path).eval(wi, wo)
        off = np.abs(ours - theirs(mitsuba, path, wi, wo))
        assert (off <= 1e-3 * np.maximum(ours, 0.01)).all(), path.name


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_rgl_files_are_read_by_another_renderer(tmp_path, mitsuba, name):
    table = LIBRARY[name]
    table.write(tmp_path / "a.bsdf")
    wi, wo = pairs(10_000, 0.1)
    found, expected = theirs(mitsuba, tmp_path / "a.bsdf", wi, wo), table.eval(wi, wo)
    off = np.abs(found - expected).mean(axis=1) / expected.mean(axis=1)
    assert np.median(off) <= 0.01
    assert np.percentile(off, 99) <= 0.05


# -- our own --------------------------------------------------------------------------------------


def test_own_files_lose_nothing(tmp_path):
    grid = tb.HalfDiffGrid(5, 4, 6, "merl")
    values = np.random.default_rng(0).random((5, 4, 6, 3), np.float32)
    tb.TabulatedBRDF(grid, values, (0.1, 0.0, 0.2), "x").write(tmp_path / "mine.npz")
    again = tb.TabulatedBRDF.read(tmp_path / "mine.npz")
    assert again.grid == grid
    assert again.name == "mine"
    np.testing.assert_array_equal(again.values, values)
    assert again.values.dtype == np.float32
    np.testing.assert_array_equal(again.mirror, [0.1, 0.0, 0.2])


def test_own_files_of_something_else(tmp_path):
    np.savez(tmp_path / "a.npz", values=np.ones((2, 2)))
    with pytest.raises(FormatError, match="a table, with values, layout and mirror, got values"):
        tb.TabulatedBRDF.read(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", values=-np.ones((2, 2, 2, 3)), layout="merl", mirror=np.zeros(3))
    with pytest.raises(FormatError, match=r"a table of a BRDF.*f >= 0"):
        tb.TabulatedBRDF.read(tmp_path / "a.npz")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"path: expected a name in \.binary, \.bsdf, \.npz"):
        LIBRARY["red-rubber"].write(tmp_path / "a.txt")
    assert not list(tmp_path.iterdir())
