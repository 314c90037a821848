"""Misuse is named: errors say which argument, what was expected, and what came."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import traitbrdf as tb
from traitbrdf.arguments import number, numbers, told, whole

GRID = tb.HalfDiffGrid(4, 4, 4)
M = tb.models


@pytest.fixture(scope="module")
def edit():
    session = tb.EditSession(tb.Scene(tb.sphere(), size=16))
    session.assign("sphere", "red-rubber")
    return session


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("folders")
    for suffix in ("binary", "npz", "bsdf", "exr", "hdr", "obj", "ply", "glb", "gltf", "tbr"):
        (made / f"x.{suffix}").mkdir()
    return made


COMPLEX = np.zeros(24, complex)

CALLS = {
    # strings for numbers
    "azimuth": lambda e: tb.Camera.orbit("35", 20),
    "fov": lambda e: tb.Camera(fov="30"),
    "size": lambda e: tb.Scene(tb.sphere(), size="16"),
    "subsamples": lambda e: tb.Scene(tb.sphere(), subsamples="4"),
    "ground": lambda e: tb.Scene(tb.sphere(), ground="yes"),
    "radius": lambda e: tb.sphere("1"),
    "center": lambda e: tb.sphere(1.0, "abc"),
    "position": lambda e: tb.PointLight(("a", 1, 2)),
    "intensity": lambda e: tb.PointLight((1, 2, 3), "bright"),
    "direction": lambda e: tb.DirectionalLight("up"),
    "rotation": lambda e: tb.EnvironmentMap(np.ones((4, 8, 3)), rotation="1"),
    "angle": lambda e: tb.EnvironmentMap.uniform().rotated("a"),
    "factor": lambda e: tb.EnvironmentMap.uniform().scaled("a"),
    "radiance": lambda e: tb.EnvironmentMap.uniform("a"),
    "sun": lambda e: tb.EnvironmentMap.sky(sun="noon"),
    "rows": lambda e: tb.EnvironmentMap.sky(rows="8"),
    "alpha": lambda e: M.GGX("0.1"),
    "eta": lambda e: M.GGX(0.1, eta="a"),
    "wi": lambda e: M.GGX().eval("a", "b"),
    "theta_o": lambda e: tb.default_library()["chrome"].albedo("a"),
    "n_theta_h": lambda e: tb.HalfDiffGrid("4", 4, 4),
    "amount of 'shiny'": lambda e: e.move("sphere", shiny="0.5"),
    "radius ": lambda e: tb.Stroke([(1, 2)], radius="3"),
    "points": lambda e: tb.Stroke("abc"),
    "rgb": lambda e: tb.Tint("red"),
    "opacity": lambda e: setattr(e.layers[0], "opacity", "a"),
    "x": lambda e: e.pick("a", 1),
    "count": lambda e: e.wedge("shiny", "7"),
    "count ": lambda e: e.variations("x"),
    "error": lambda e: tb.EditSession(e.scene, error="1"),
    "fps": lambda e: tb.EditSession(e.scene, fps="60"),
    "theta_h": lambda e: tb.default_embedding().encode_samples("a", [0], [0], [[1, 1, 1]]),
    # complex tables, objects, other types
    "values": lambda e: tb.TabulatedBRDF(GRID, np.ones((4, 4, 4, 3), complex)),
    "values ": lambda e: tb.TabulatedBRDF(GRID, np.ones((4, 4, 4, 3), object)),
    "grid": lambda e: tb.TabulatedBRDF((4, 4, 4), np.ones((4, 4, 4, 3))),
    "grid ": lambda e: tb.TabulatedBRDF.from_model(M.GGX(), (4, 4, 4)),
    "radiance ": lambda e: tb.EnvironmentMap(np.ones((4, 8, 3), complex)),
    "k_d": lambda e: M.Lambert(1j),
    "material": lambda e: e.assign("sphere", COMPLEX),
    "z": lambda e: tb.default_embedding().decode(COMPLEX),
    "z ": lambda e: tb.default_traits().score(COMPLEX),
    "amount of 'shiny' ": lambda e: e.move("sphere", shiny=1j),
    "amounts": lambda e: tb.default_traits().move(np.zeros(24), "shiny"),
    "hold": lambda e: tb.default_traits().reach(np.zeros(24), {"shiny": 0.1}, hold=5),
    "hold ": lambda e: e.move("sphere", shiny=0.1, hold=3),
    "part": lambda e: e.assign(0, "chrome"),
    "environments": lambda e: e.under("studio.exr"),
    "lights": lambda e: tb.Scene(tb.sphere(), lights=tb.PointLight((1, 2, 3))),
    "camera": lambda e: tb.Scene(tb.sphere(), camera=(35, 20)),
    "scene": lambda e: tb.EditSession(tb.sphere()),
    "scene ": lambda e: tb.reference.render("x", {}),
    "stroke": lambda e: e.paint([(8, 8)]),
    "effect": lambda e: e.paint(tb.Stroke([(8, 8)]), "shiny"),
    "design": lambda e: setattr(e, "design", 3),
    "path": lambda e: tb.TabulatedBRDF.read(3),
    "path ": lambda e: tb.load_mesh(None),
    "path  ": lambda e: tb.EnvironmentMap.read(None),
    "path   ": lambda e: e.export(3),
    # a class for a model, a function for a shape
    "material  ": lambda e: e.assign("sphere", M.Lambert),
    "material   ": lambda e: tb.Assign(M.GGX),
    "model": lambda e: tb.TabulatedBRDF.from_model(M.GGX, GRID),
    "brdf": lambda e: tb.default_embedding().encode(M.GGX),
    "brdfs": lambda e: tb.reference.render(e.scene, {"sphere": M.GGX}),
    "shape": lambda e: tb.Scene(tb.sphere),
    "effect ": lambda e: e.paint(tb.Stroke([(8, 8)]), tb.Move),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CALLS, ids=lambda name: name.replace(" ", "_"))
def test_errors_name_the_argument(edit, name):
    before = edit.history
    with pytest.raises((TypeError, ValueError)) as caught:
        CALLS[name](edit)
    text = str(caught.value)
    assert text.startswith(name.strip())
    assert "expected" in text
    assert len(text) < 500
    assert edit.history == before


FILES = {
    "tb.TabulatedBRDF.read": [
        lambda e: e.assign("sphere", "gold.binary"),
        lambda e: e.assign("sphere", Path("gold.binary")),
        lambda e: tb.Assign("a/b.npz"),
        lambda e: tb.default_library()["gold.binary"],
        lambda e: tb.default_embedding().encode(Path("a.binary")),
        lambda e: tb.reference.render(e.scene, {"sphere": "a.binary"}),
    ],
    "tb.MeasuredBRDF.read": [
        lambda e: e.assign("sphere", "x/y.bsdf"),
        lambda e: tb.TabulatedBRDF.from_model("felt.BSDF", GRID),
    ],
    "tb.default_library": [lambda e: tb.TabulatedBRDF.from_model("chrome", GRID)],
    "tb.EnvironmentMap.read": [lambda e: tb.Scene(tb.sphere(), "studio.exr")],
    "tb.load_mesh": [lambda e: tb.Scene("chair.obj")],
}


@pytest.mark.parametrize(
    ("reader", "call"), [(reader, call) for reader, calls in FILES.items() for call in calls]
)
def test_a_file_name_points_to_its_reader(edit, reader, call):
    with pytest.raises((TypeError, ValueError)) as caught:
        call(edit)
    assert reader in str(caught.value)


@pytest.mark.parametrize(
    ("read", "suffixes"),
    [
        (tb.TabulatedBRDF.read, ("binary", "npz")),
        (tb.MeasuredBRDF.read, ("bsdf",)),
        (tb.EnvironmentMap.read, ("exr", "hdr")),
        (tb.load_mesh, ("obj", "ply", "glb", "gltf")),
        (tb.EditSession.load, ("tbr",)),
    ],
)
def test_a_folder_is_no_file(folder, read, suffixes):
    for suffix in suffixes:
        path = folder / f"x.{suffix}"
        with pytest.raises((OSError, ValueError)) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "folder" in str(caught.value) or "directory" in str(caught.value)


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
def test_integers_of_numpy_are_integers(edit, kind):
    assert tb.Scene(tb.sphere(), size=kind(16), subsamples=kind(4)).height == 16
    assert tb.HalfDiffGrid(kind(4), kind(5), kind(6)).shape == (4, 5, 6)
    assert tb.EnvironmentMap.sky(rows=kind(8)).image.shape == (8, 16, 3)
    assert M.GGX(kind(1)).alpha == 1.0
    assert tb.Camera.orbit(kind(35), kind(20)) == tb.Camera.orbit(35, 20)
    assert tb.Stroke([(kind(1), kind(2))], radius=kind(3)).radius == 3
    assert edit.pick(kind(8), kind(8)).part == "sphere"
    edit.move("sphere", shiny=kind(0))
    edit.layers[-1].opacity = kind(1)
    edit.undo()
    edit.undo()
    assert repr(tb.HalfDiffGrid(kind(4), 4, 4)) == repr(tb.HalfDiffGrid(4, 4, 4))


def test_numbers_are_checked():
    assert number(np.float32(0.5), "a") == 0.5
    assert whole(np.int8(3), "a", 0) == 3
    assert numbers([1, 2], "a").tolist() == [1, 2]
    for bad in ("1", 1j, None, [1], True, np.bool_(True), M.GGX):
        with pytest.raises(TypeError, match="a: expected a number"):
            number(bad, "a")
    for bad in (1.0, "1", True, -1, None):
        with pytest.raises(ValueError, match="a: expected a whole number of at least 0"):
            whole(bad, "a", 0)
    for bad in ("x", [1, [2]], [None], [1j], {}):
        with pytest.raises(TypeError, match="a: expected real numbers"):
            numbers(bad, "a")
    with pytest.raises(ValueError, match="finite"):
        number(float("nan"), "a")
    assert told(M.GGX) == "the class GGX"
    assert len(told("x" * 500)) == 80
