"""The command line: what it writes, says, and how it fails."""

from __future__ import annotations

import json
import re
import sys
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import traitbrdf as tb
from traitbrdf.bench import datasets, peers
from traitbrdf.bench.datasets import HELD_OUT, unseen
from traitbrdf.bench.edits import frame_error, peak_memory
from traitbrdf.bench.oracle import Oracle, draw_fragments, reference_values
from traitbrdf.bench.records import ON_REQUEST, Record
from traitbrdf.bench.rivals import texel_sum, texel_sum_torch
from traitbrdf.bench.run import BENCHES
from traitbrdf.cli import _Progress, main
from traitbrdf.formats.images import read_image, write_exr

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


def wait_for(condition: Callable[[], bool]) -> bool:
    """Whether it comes true within ten seconds."""
    for _ in range(200):
        if condition():
            return True
        time.sleep(0.05)
    return False


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_ground(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Given as a flag, with a radius, or not; the ground is a part and is saved with the design."""

    def shown(*arguments: str) -> np.ndarray:
        out = tmp_path / "x.exr"
        common = ["--shape", "sphere", "--size", "24", "--camera", "20", "25", "1"]
        assert main(["render", *common, *arguments, "--out", str(out)]) == 0
        return read_image(out)

    plain, flag, wide = shown(), shown("--ground"), shown("--ground", "5")
    np.testing.assert_array_equal(shown("--ground", "0"), plain)
    np.testing.assert_array_equal(shown("--ground", "2"), flag)
    changed, further = ((other != plain).any(axis=-1) for other in (flag, wide))
    assert 0.1 < changed.mean() < further.mean()
    out, design = tmp_path / "x.png", tmp_path / "x.tbr"
    assert main([
        "paint", "--shape", "sphere", "--size", "24", "--ground", "--trait", "shiny=0.5",
        "--out", str(out), "--save", str(design),
    ]) == 0  # fmt: skip
    assert "sphere: shiny" in capsys.readouterr().out
    session = tb.EditSession.load(design)
    assert session.scene.parts == ("sphere", "ground")
    assert session.material("ground").name != session.material("sphere").name
    assert "ground" in fails(capsys, "render", "--ground", "-1", "--size", "16", "--out", str(out))


def test_the_demo_stands_on_the_ground(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--shape", "sphere", "--size", "32", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert set(report["parts"]) == {"sphere", "ground"}
    assert report["demo"]["changed_outside"] == 0
    said = capsys.readouterr()
    assert re.search(r"prepared \([\d.]+ s: loading [\d.]+ s, compiling", said.out)
    assert re.search(r"after [\d.]+ s: preparation [\d.]+ s, pictures [\d.]+ s, all", said.out)
    lines = said.err.splitlines()
    assert all(re.fullmatch(r"[a-z ]+: \d+ %, \d+ s", line) for line in lines)
    assert [line.split(":")[0] for line in lines][:3] == ["loading", "compiling", "tables"]


class Clock:
    """Seconds that pass when told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        clock = types.SimpleNamespace(perf_counter=lambda: self.now)
        monkeypatch.setattr("traitbrdf.cli.time", clock)


def test_progress_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line for each new stage, and otherwise one every few seconds."""
    clock, progress = Clock(monkeypatch), _Progress()
    for second in range(20):
        clock.now = float(second)
        progress(("near", "far")[second % 2], second / 20)
    clock.now = 25.0
    progress.__enter__().__exit__()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["near: 0 %, 0 s", "far: 5 %, 1 s", "far: 35 %, 7 s"]
    assert len(lines) <= 6
    assert progress.seconds == {"near": 10.0, "far": 15.0}


def test_progress_while_nothing_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock(monkeypatch)
    with _Progress() as progress:
        progress("compiling", 0.0)
        clock.now = 6.0
        assert wait_for(lambda: "compiling: 0 %, 6 s\n" in capsys.readouterr().err)


def test_progress_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that changes, and is gone at the end."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with pytest.raises(ValueError, match="wrong"), _Progress() as progress:
        progress("near", 0.25)
        raise ValueError("wrong")
    said = capsys.readouterr().err
    assert said.startswith("\rnear: 25 %, 0 s")
    assert said.endswith(" \r")
    assert "\n" not in said


@pytest.mark.slow
def test_render_by_the_oracle_agrees(tmp_path: Path) -> None:
    fast, slow = tmp_path / "fast.exr", tmp_path / "slow.exr"
    common = ["render", "--shape", "sphere", "--size", "8", "--material", "red-rubber"]
    assert main([*common, "--out", str(fast)]) == 0
    assert main([*common, "--reference", "--out", str(slow)]) == 0
    assert tb.reference.relative_error(read_image(fast), read_image(slow)) < 0.01


def test_info(tmp_path: Path, shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    said = capsys.readouterr().out
    assert "2040 materials" in said
    assert "red-rubber" in said
    write_exr(tmp_path / "grey.exr", np.full((4, 8, 3), 0.5, np.float32))
    assert main(["info", str(tmp_path / "grey.exr")]) == 0
    assert "4 rows by 8 columns" in capsys.readouterr().out
    assert main(["info", str(shared_data / "rgl" / "acrylic_felt_purple_rgb.bsdf")]) == 0
    assert "albedo at" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("table", ["table error, median"]),
        ("embedding", ["decoding the cells of a scene", "decoding a full table"]),
        ("shadows", ["error in the shade, median", "a one-texel sun: lit or dark as a ray says"]),
        pytest.param(
            "transport",
            ["transport error, 95th percentile", "tone-mapped PSNR, 5th percentile"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "families",
            [
                "left out: cases with an error above 1 %",
                "left out: error of all as shown, 95th percentile",
            ],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "edit",
            ["edit of the whole object to frame, 64x64, median", "plain sum over texels, a frame"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "prepare",
            ["preparation", "preparation from the cache on disk",
             "first image after a change of view"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "live",
            ["live after a change of light, 1000 nodes",
             "edit to frame after a change of view, 4000 nodes"],
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_bench_writes_records(
    name: str,
    expected: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TRAITBRDF_SHARED", raising=False)
    assert main(["bench", name, "--quick", "--json", "records.json"]) == 0
    records = json.loads((tmp_path / "records.json").read_text())
    for record in records:
        assert {"name", "value", "unit", "target", "met", "error", "how"} == set(record)
        assert np.isfinite(record["value"])
        assert (record["target"] is None) == (record["met"] is None)
        if record["unit"] == "ms":  # a timed result was checked
            assert 0.0 < record["error"] < 0.05
    named = {record["name"] for record in records}
    assert set(expected) <= named
    said = capsys.readouterr().out
    assert all(name in said for name in named)


def test_record_says_when_a_target_is_missed() -> None:
    assert Record.at_most("x", 1.0, "%", 2.0).met is True
    assert Record.at_least("x", 1.0, "dB", 2.0).met is False
    assert Record.at_least("x", 2.0, "dB", 2.0).met is True
    missed = Record.at_most("x", 3.0, "%", 2.0)
    assert missed.met is False
    assert "MISSED" in missed.line()


def test_texel_sum_is_the_reference_for_a_rough_surface() -> None:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=64), size=8, subsamples=1)
    brdf = tb.default_library()["white-plaster"]
    index = np.arange(0, len(scene.pixels), 7)
    plain = texel_sum(scene, index, brdf)
    true, _ = reference_values(scene, index, [brdf], 1e-4)
    assert tb.reference.relative_error(plain, true[:, 0]) < 2e-3


def test_the_texel_sum_in_torch_is_that_in_numpy() -> None:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=64).rotated(0.7), size=10)
    index = np.flatnonzero(~scene.bordering)[::3]
    for name in ("gold-polished", "blue-plastic"):
        brdf = tb.default_library()[name]
        plain = texel_sum(scene, index, brdf)
        other = texel_sum_torch(scene, index, brdf)
        np.testing.assert_allclose(other, plain, rtol=1e-3)
    merl = tb.TabulatedBRDF(tb.HalfDiffGrid(4, 4, 4, "merl"), np.ones((4, 4, 4, 3)))
    with pytest.raises(ValueError, match="folded"):
        texel_sum_torch(scene, index, merl)


def test_unseen_tables_are_new() -> None:
    kinds = unseen(None, quick=True)
    assert {"held-out library", "new recipes", "manifold moves", "models"} <= set(kinds)
    library = tb.default_library()
    known = [library[name].values for name in library.names]
    for table in kinds["new recipes"]:
        assert min(float(np.abs(values - table.values).max()) for values in known) > 1e-3
    held = {library.names[i] for i in range(0, len(library), HELD_OUT)}
    assert {table.name for table in kinds["held-out library"]} <= held


def test_without_the_recipe_there_are_more_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    with_recipes = unseen(None, quick=True)
    monkeypatch.setattr(datasets, "fresh_recipes", lambda count, seed=1: [])
    without = unseen(None, quick=True)
    assert "new recipes" not in without
    assert sum(map(len, without.values())) == sum(map(len, with_recipes.values()))


@pytest.mark.slow
def test_the_oracle_on_several_cores_is_the_same() -> None:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=12, subsamples=2)
    brdfs = [tb.default_library()[name] for name in ("white-plaster", "gold-satin")]
    index = np.arange(0, len(scene.pixels), len(scene.pixels) // 40)
    assert len(index) >= 32  # fewer are computed in one process
    values, errors = reference_values(scene, index, brdfs, 1e-2)
    expected = tb.reference.fragments(scene, index, brdfs, 1e-2)
    np.testing.assert_array_equal(values, expected[0])
    np.testing.assert_array_equal(errors, expected[1])


def test_what_the_oracle_refuses_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=8, subsamples=1)
    whole = tb.reference.fragments

    def picky(scene, index, brdfs, tolerance):  # type: ignore[no-untyped-def]
        if np.any(index % 7 == 0):
            raise tb.reference.IntegrationError("point 0: too hard")
        return whole(scene, index, brdfs, tolerance)

    monkeypatch.setattr(tb.reference, "fragments", picky)
    oracle = Oracle([tb.default_library()["white-plaster"]], 1e-2, cores=1)
    every = np.arange(len(scene.pixels))
    values, _ = oracle(scene, every)
    np.testing.assert_array_equal(np.isnan(values).any(axis=(1, 2)), every % 7 == 0)
    index, known, _ = draw_fragments(oracle, scene, every, 20, np.random.default_rng(0))
    assert np.isfinite(known).all()
    assert not np.any(index % 7 == 0)
    np.testing.assert_array_equal(known, values[index])


@pytest.mark.slow
def test_frame_errors_are_those_of_whole_pixels() -> None:
    """Against the oracle's own picture, borders and backdrop included."""
    scene = tb.Scene(
        tb.sphere(), tb.EnvironmentMap.sky(rows=128), camera=tb.Camera.orbit(20.0, 25.0, zoom=0.8),
        size=10, ground=1.2, subsamples=2,
    )  # fmt: skip
    session = tb.EditSession(scene, quality="preview")
    session.assign("sphere", "white-plaster")
    frame = session.render()
    stated = frame_error(session, len(scene.pixels), np.random.default_rng(0))
    brdfs = {name: session.brdf(name) for name in scene.parts}
    true = tb.reference.render(scene, brdfs, 1e-3).reshape(-1, 3)
    backdrop = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
    covered = np.unique(scene.pixels)
    expected = tb.reference.relative_error(
        frame.reshape(-1, 3)[covered] - backdrop[covered], true[covered] - backdrop[covered]
    )
    assert 0.0 < stated < 0.05
    assert stated == pytest.approx(expected, rel=0.02)


def test_peak_memory() -> None:
    peak = peak_memory()
    assert peak is None or 0.05 < peak < 100.0


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


def test_bench_beside_mitsuba_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    peers.load.cache_clear()
    try:
        assert "traitbrdf[peers]" in fails(capsys, "bench", "--peers", "--quick")
    finally:
        peers.load.cache_clear()


def test_mitsuba_is_for_those_who_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []
    for name in BENCHES:

        def noted(*_: object, name: str = name) -> Iterator[Record]:
            """Measure nothing."""
            called.append(name)
            return iter(())

        monkeypatch.setitem(BENCHES, name, noted)
    assert main(["bench"]) == 0
    assert "edit" in called
    assert not ON_REQUEST & set(called)
    for arguments in (["--peers"], ["peers"], ["peers", "--peers"]):
        called.clear()
        assert main(["bench", *arguments]) == 0
        assert called == ["peers"]
    called.clear()
    assert main(["bench", "edit", "--peers"]) == 0
    assert called == ["edit", "peers"]


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


@pytest.mark.parametrize("command", ["demo", "paint", "render", "info", "compile", "bench"])
def test_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    assert "usage:" in capsys.readouterr().out
