"""Speed against accuracy: what the benches say, and what they draw."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from PIL import Image

from traitbrdf.bench import trade
from traitbrdf.bench.datasets import default_data
from traitbrdf.bench.trade import TradePoint, coarser, knee, knot, pareto, vase
from traitbrdf.cli import main
from traitbrdf.scene.lights import EnvironmentMap


def point(milliseconds, error, megabytes=1.0):
    return TradePoint(8, "float32", 1.0, milliseconds, megabytes, error, 2.0 * error, 1.0)


def test_a_front_is_what_nothing_beats():
    points = [
        point(1.0, 0.1),
        point(2.0, 0.02),
        point(3.0, 0.03),
        point(4.0, 0.01),
        point(2.0, 0.2),
    ]
    front = pareto(points)
    assert [p.milliseconds for p in front] == [1.0, 2.0, 4.0]
    # less memory counts too, and equal points do not beat each other
    assert len(pareto([*points, point(3.0, 0.03, 0.5)])) == 4
    assert len(pareto([points[0], points[0]])) == 2


def test_a_knee_is_where_time_stops_paying():
    front = [point(1.0, 0.1), point(1.5, 0.02), point(2.0, 0.004), point(8.0, 0.0035)]
    assert knee(front).milliseconds == 2.0
    assert knee(front[:1]) is front[0]
    assert knee([*front, point(1.2, 0.5)]).milliseconds == 2.0  # a dominated point does not matter


def test_coarser_maps_hold_the_same_light():
    image = np.random.default_rng(0).random((32, 64, 3)) ** 6
    whole = EnvironmentMap(image, 0.3)
    half = coarser(whole, 4)
    assert half.image.shape == (8, 16, 3)
    assert half.rotation == whole.rotation
    energy = [np.einsum("ijc,i->c", m.image.astype(float), m.solid_angles) for m in (whole, half)]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-5)
    np.testing.assert_array_equal(coarser(whole, 1).image, whole.image)
    with pytest.raises(ValueError, match="divisor of 32 and 64"):
        coarser(whole, 3)


@pytest.mark.parametrize("make", [knot, vase])
def test_shapes_have_outward_normals(make):
    """The winding of the faces agrees with their normals."""
    mesh = make(60, 20)
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.einsum("fk,fk->f", across, mesh.normals[mesh.faces[:, 0]])
    # all to one side
    assert np.mean(np.sign(facing) == np.sign(facing[0])) > 0.999
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0)
    if make is vase:
        out = np.einsum("vk,vk->v", mesh.normals[:, [0, 2]], mesh.vertices[:, [0, 2]])
        assert (out > 0.0).all()


def test_bandwidth_is_plausible():
    assert 1e8 < trade.bandwidth(0.05) < 1e13


@pytest.mark.slow
def test_the_trade_is_printed_written_and_drawn(tmp_path, capsys):
    arguments = ["bench", "--trade", "--quick", "--out", str(tmp_path / "t")]
    assert main([*arguments, "--json", str(tmp_path / "r.json")]) == 0
    said = capsys.readouterr().out
    for words in ("knee", "basis images", "float16", "visibility rays", "table grid", "embedding"):
        assert words in said
    found = json.loads((tmp_path / "t" / "trade.json").read_text())
    together = found["together"]
    assert sum(p["knee"] for p in together) == 1
    assert all(p["pareto"] for p in together if p["knee"])
    for entry in (*together, *found["alone"]):
        assert 0.0 < entry["error"] < 1.0
        assert entry["error"] <= entry["error_95"] * (1 + 1e-9)
    most = [p for p in together if p["dtype"] == "float32" and p["resolution"] == 1.0]
    errors = [p["error"] for p in sorted(most, key=lambda p: p["images"])]
    assert errors[-1] < errors[0]  # more images err less
    with Image.open(tmp_path / "t" / "trade.png") as picture:
        assert picture.size[0] > 800
        assert np.asarray(picture.convert("L")).std() > 10.0
    records = json.loads((tmp_path / "r.json").read_text())
    assert all(math.isfinite(r["value"]) and r["error"] is not None for r in records)


@pytest.mark.slow
def test_promises_are_held_against_the_oracle(capsys):
    """A small run; the bench measures the full figures."""
    said = []
    records = list(trade.promises_kept(default_data(), True, said.append))
    shares = {r.name: r.value for r in records if "meet it" in r.name}
    assert len(shares) == 2
    assert min(shares.values()) >= 0.9
    speeds = [r for r in records if r.name.startswith("fps=")]
    assert speeds
    assert all(r.error is not None and 0.0 < r.error < 0.5 for r in speeds)
