"""The command line: what it writes, says, and how it fails."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import traitbrdf as tb
from traitbrdf import bench
from traitbrdf.cli import main
from traitbrdf.formats import read_image, write_exr

MAPS = ("forest", "lobby", "night", "studio", "sunset", "venice", "warehouse", "workshop")


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line with which a command fails."""
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert said.startswith("traitbrdf: ")
    assert len(said.strip().splitlines()) == 1
    return said


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["teapot", "sphere"])
@pytest.mark.parametrize("name", MAPS)
def test_demo_under_real_maps(
    name: str, shape: str, shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = shared_data / "envmaps" / f"{name}.exr"
    arguments = [
        "demo",
        "--env",
        str(env),
        "--shape",
        shape,
        "--size",
        "48",
        "--out",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["demo"]["changed_outside"] == 0
    assert report["demo"]["risen"] >= 0.9 * report["demo"]["asked"]
    assert report["frame_error"] < 0.015
    before, after = picture(tmp_path / "before.png"), picture(tmp_path / "after.png")
    assert before.shape == after.shape == (48, 48, 3)
    assert (before != after).any()
    assert picture(tmp_path / "side_by_side.png").shape == (48, 96, 3)
    radiance = read_image(tmp_path / "after.exr")
    assert radiance.shape == (48, 48, 3)
    assert np.isfinite(radiance).all()
    assert radiance.min() >= 0.0
    assert "% of what was asked" in capsys.readouterr().out


def test_paint_writes_a_picture_and_a_design(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, design = tmp_path / "new" / "x.png", tmp_path / "x.tbr"
    assert main([
        "paint", "--size", "32", "--part", "lid", "--trait", "shiny=0.6", "--trait", "red=0.2",
        "--hold", "bright", "--out", str(out), "--save", str(design),
    ]) == 0  # fmt: skip
    assert "lid: shiny" in capsys.readouterr().out
    assert picture(out).shape == (32, 32, 3)
    again = tmp_path / "again.exr"
    assert main(["render", "--design", str(design), "--out", str(again)]) == 0
    session = tb.EditSession.load(design)
    np.testing.assert_array_equal(session.render(), read_image(again))


def test_render_by_the_oracle_agrees(tmp_path: Path) -> None:
    fast, slow = tmp_path / "fast.exr", tmp_path / "slow.exr"
    common = ["render", "--shape", "sphere", "--size", "8", "--material", "red-rubber"]
    assert main([*common, "--out", str(fast)]) == 0
    assert main([*common, "--reference", "--out", str(slow)]) == 0
    assert tb.reference.relative_error(read_image(fast), read_image(slow)) < 0.01


def test_info(tmp_path: Path, shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    said = capsys.readouterr().out
    assert "400 materials" in said
    assert "red-rubber" in said
    write_exr(tmp_path / "grey.exr", np.full((4, 8, 3), 0.5, np.float32))
    assert main(["info", str(tmp_path / "grey.exr")]) == 0
    assert "4 rows by 8 columns" in capsys.readouterr().out
    assert main(["info", str(shared_data / "rgl" / "acrylic_felt_purple_rgb.bsdf")]) == 0
    assert "albedo at" in capsys.readouterr().out


def test_bench_writes_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRAITBRDF_SHARED", raising=False)
    assert main(["bench", "table", "--quick", "--json", "records.json"]) == 0
    records = json.loads((tmp_path / "records.json").read_text())
    assert {"name", "value", "unit", "target", "met", "error", "how"} == set(records[0])
    assert all(np.isfinite(record["value"]) for record in records)
    assert "table error, median" in capsys.readouterr().out


def test_record_says_when_a_target_is_missed() -> None:
    assert bench.Record.at_most("x", 1.0, "%", 2.0).met is True
    missed = bench.Record.at_most("x", 3.0, "%", 2.0)
    assert missed.met is False
    assert "MISSED" in missed.line()


def test_texel_sum_is_the_reference_for_a_rough_surface() -> None:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=64), size=8, subsamples=1)
    brdf = tb.default_library()["white-plaster"]
    index = np.arange(0, len(scene.pixels), 7)
    plain = bench.texel_sum(scene, index, brdf)
    true, _ = bench.reference_values(scene, index, [brdf], 1e-4)
    assert tb.reference.relative_error(plain, true[:, 0]) < 2e-3


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["paint", "--part", "handel", "--trait", "shiny=1"], "handle"),
        (["paint", "--trait", "shinny=1"], "shiny"),
        (["paint", "--trait", "shiny=1", "--material", "red-ruber"], "red-rubber"),
        (["render", "--material", "gold-polishd"], "gold-polished"),
        (["render", "--material", "none.binary"], "none.binary"),
        (["render", "--env", "none.exr"], "none.exr"),
    ],
)
def test_unknown_names_are_answered_with_near_ones(
    arguments: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.png"
    said = fails(capsys, *arguments, "--size", "16", "--out", str(out))
    assert expected in said
    assert not out.exists()


def test_bad_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = tmp_path / "text.exr"
    text.write_text("no picture")
    out = str(tmp_path / "x.png")
    assert "text.exr" in fails(capsys, "demo", "--env", str(text), "--out", str(tmp_path))
    negative = tmp_path / "negative.exr"
    light = np.ones((8, 16, 3), np.float32)
    light[3, 3] = -1.0
    write_exr(negative, light)
    assert "negative" in fails(capsys, "render", "--env", str(negative), "--out", out)
    light[3, 3] = np.nan
    write_exr(negative, light)
    assert "finite" in fails(capsys, "render", "--env", str(negative), "--out", out)
    design = tmp_path / "broken.tbr"
    design.write_bytes(b"PK\x03\x04 broken")
    assert "broken.tbr" in fails(capsys, "render", "--design", str(design), "--out", out)
    assert ".gif" in fails(capsys, "render", "--out", str(tmp_path / "x.gif"))
    assert ".txt" in fails(capsys, "info", str(tmp_path / "x.txt"))


def test_unknown_bench(capsys: pytest.CaptureFixture[str]) -> None:
    assert "transport" in fails(capsys, "bench", "transprt")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["demo", "--size", "0"],
        ["demo", "--size", "many"],
        ["demo", "--shape", "cube"],
        ["paint", "--out", "x.png"],
        ["paint", "--trait", "shiny", "--out", "x.png"],
        ["paint", "--trait", "shiny=nan", "--out", "x.png"],
        ["nonsense"],
    ],
)
def test_wrong_usage_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert "usage:" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["demo", "paint", "render", "info", "bench"])
def test_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    assert "usage:" in capsys.readouterr().out
