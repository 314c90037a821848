"""The assertions that we offer: each holds where it should, and says where and by how much."""

from __future__ import annotations

import numpy as np
import pytest

import traitbrdf as tb
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
