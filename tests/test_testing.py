"""The assertions that we offer: each holds where it should, and says where and by how much."""

from __future__ import annotations

import json

import numpy as np
import pytest

import traitbrdf as tb
from traitbrdf.cli import main
from traitbrdf.formats.images import read_image, write_exr
from traitbrdf.testing import assert_frame, assert_physical, assert_same_look, assert_traits

LIBRARY = tb.default_library()


def changed(table: tb.TabulatedBRDF, change) -> tb.TabulatedBRDF:
    values = table.values.copy()
    change(values)
    return tb.TabulatedBRDF(table.grid, values, name=table.name)


class Odd:
    """A reflectance that is wrong in one way."""

    mirror = np.zeros(3)

    def __init__(self, function) -> None:
        self.function = function

    def eval(self, wi, wo):
        return self.function(np.asarray(wi), np.asarray(wo))[..., None] * np.ones(3)


@pytest.mark.parametrize(
    "brdf", [tb.models.Lambert(0.5), tb.models.GGX(alpha=0.3), tb.models.OrenNayar()]
)
def test_models_are_physical(brdf):
    assert_physical(brdf)


def test_measured_materials_are_physical(shared_data):
    angles = np.radians([0.0, 30.0, 60.0, 75.0])
    assert_physical(tb.MeasuredBRDF.read(shared_data / "rgl" / "satin_rosaline_rgb.bsdf"),
                    angles=angles)  # fmt: skip


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda i, o: np.where(i[..., 2] > 0.9, np.nan, 0.1), "not finite: f .nan.* theta_i"),
        (lambda i, o: 0.1 - 0.2 * (o[..., 2] < 0.05), "negative: f .-0.1.*theta_o 8[78]"),
        (lambda i, o: 0.1 + 0.1 * i[..., 2], "not reciprocal: f .0.1"),
        (lambda i, o: np.full(i.shape[:-1], 0.4), r"more light than arrives: albedo .1\.25.* at 0"),
        (lambda i, o: 0.1 / np.maximum(i[..., 2] * o[..., 2], 1e-3), "albedo .* at 55 degrees"),
        (lambda i, o: 0.1 * (np.abs(i[..., 2] + o[..., 2] - 1.2) > 0.05), "a hole: f is 0 at thet"),
    ],
)
def test_each_fault_is_told_with_its_place(function, message):
    with pytest.raises(AssertionError, match=message):
        assert_physical(Odd(function))


def test_traits():
    assert_traits(LIBRARY["gold-polished"], metallic=(0.8, 2.0), shiny=(0.5, 3.0))
    with pytest.raises(AssertionError, match=r"^metallic is -?\d\.\d\d, not 0\.8 to 2$"):
        assert_traits(LIBRARY["red-rubber"], metallic=(0.8, 2.0))
    with pytest.raises(ValueError, match="unknown trait 'metalic'"):
        assert_traits(LIBRARY["red-rubber"], metalic=(0.8, 2.0))
    with pytest.raises(ValueError, match=r"shiny: expected \(low, high\)"):
        assert_traits(LIBRARY["red-rubber"], shiny=(0.8, 0.2))


def test_same_look(tmp_path):
    table = LIBRARY["red-rubber"]
    assert_same_look(table, table, delta_e=0.0)
    table.write(tmp_path / "a.binary")
    assert_same_look(table, tb.TabulatedBRDF.read(tmp_path / "a.binary"), delta_e=1.0)
    brighter = changed(table, lambda values: np.multiply(values, 1.2, out=values))
    with pytest.raises(AssertionError, match=r"red-rubber differ by delta E \d.* 100 % of|9\d %"):
        assert_same_look(table, brighter)


def test_frames():
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=32)
    edit = tb.EditSession(scene, cache=False)
    edit.assign("sphere", "red-rubber")
    assert_frame(edit, error=0.01, pixels=12)
    with pytest.raises(AssertionError, match=r"off by 0\.\d\d %, more than 0 %: most at pixel \("):
        assert_frame(edit, error=0.0, pixels=12)


# -- files and the command line -------------------------------------------------------------------


def test_validate_names_each_fault_in_a_line(tmp_path, capsys):
    good, odd, cut = tmp_path / "good.npz", tmp_path / "odd.npz", tmp_path / "cut.exr"
    bright = tmp_path / "bright.npz"
    LIBRARY["red-rubber"].write(good)
    changed(LIBRARY["red-rubber"], lambda v: np.multiply(v, 9.0, out=v)).write(bright)
    odd.write_bytes(good.read_bytes()[:-40])
    cut.write_bytes(b"\x76\x2f\x31\x01")
    mesh = tmp_path / "a.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert main(["validate", str(good), str(mesh)]) == 0
    assert capsys.readouterr().out == ""
    assert main(["validate", str(good), str(odd), str(bright), str(cut), str(mesh)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[0] for line in lines] == [str(odd), str(bright), str(cut)]
    assert "more light than arrives: albedo" in lines[1]
    assert main(["validate", "--json", str(good), str(cut)]) == 1
    records = json.loads(capsys.readouterr().out)
    assert [len(r["faults"]) for r in records] == [0, 1]
    assert main(["validate", str(tmp_path / "a.doc")]) == 1
    assert "unknown kind of file '.doc'" in capsys.readouterr().err
    assert main(["validate", str(tmp_path / "none.exr")]) == 1
    assert "no such file" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".binary", ".bsdf", ".npz"])
def test_convert_materials(tmp_path, capsys, suffix):
    first, second = tmp_path / f"a{suffix}", tmp_path / "b.npz"
    assert main(["convert", "red-rubber", str(first)]) == 0
    assert main(["convert", str(first), str(second)]) == 0
    assert_same_look(LIBRARY["red-rubber"], tb.TabulatedBRDF.read(second))
    assert "b.npz: TabulatedBRDF" in capsys.readouterr().out


def test_convert_maps_and_refusals(tmp_path, capsys):
    pixels = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", pixels)
    assert main(["convert", str(tmp_path / "a.exr"), str(tmp_path / "b.exr")]) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr"), pixels)
    assert main(["convert", str(tmp_path / "a.exr"), str(tmp_path / "b.png")]) == 0
    assert main(["convert", str(tmp_path / "a.exr"), str(tmp_path / "b.npz")]) == 1
    assert "expected a name in .exr or .png" in capsys.readouterr().err
    assert main(["convert", "red-rubber", str(tmp_path / "b.txt")]) == 1
    assert "expected a name in .binary, .bsdf, .npz" in capsys.readouterr().err
    assert not (tmp_path / "b.txt").exists()
