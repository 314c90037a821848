"""The recipe: the shipped artifact is what it makes; labels look at tables alone."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_gen import __main__ as command
from data_gen import packing, study, tables
from data_gen.labels import TRAITS, grading, labels
from data_gen.packing import build
from data_gen.tables import table_of
from traitbrdf.bench.datasets import MeasuredSet
from traitbrdf.formats.files import artifact, read_arrays
from traitbrdf.recipes import families, spectra
from traitbrdf.recipes.families import FAMILIES
from traitbrdf.recipes.looks import DIGITS, METALS
from traitbrdf.recipes.materials import materials
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.reflectance.descriptors import DESCRIPTORS, descriptors
from traitbrdf.reflectance.models import GGX, Lambert, Plastic, fresnel_conductor
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.space.embedding import GRID, BRDFEmbedding
from traitbrdf.space.library import default_library
from traitbrdf.space.logmap import FLOOR
from traitbrdf.space.traits import TraitSpace

ROOT = Path(__file__).resolve().parents[1]
COARSE = HalfDiffGrid(45, 12, 5)


def assert_same_build(made, other):
    """What is drawn is the same to the last digit; what is fitted decodes to the same, and says the
    same of members.

    A fit carries rounding on, and processors round differently: axes and cells are others that do
    as well, so their numbers are not compared.
    """
    assert set(made) == set(other)
    for name in ("names", "families", "parameters", "seed", "grid", "n_components", "trait_names",
                 "trait_weights", "descriptor_names", "grade_names"):  # fmt: skip
        np.testing.assert_array_equal(made[name], other[name], err_msg=name)
    assert_same_descriptors(
        *(dict(zip(b["descriptor_names"], b["descriptors"].T, strict=True)) for b in (made, other))
    )
    # a member on the border between yes and unclear may fall to either side
    assert np.mean(made["labels"] != other["labels"]) < 0.002
    name = "explained_variance_ratio"
    np.testing.assert_allclose(made[name], other[name], atol=1e-5)
    members = [b["coordinates"][:: max(len(b["names"]) // 40, 1)] for b in (made, other)]
    one, two = (BRDFEmbedding.from_arrays(b) for b in (made, other))
    off = [
        np.abs(np.log((one.decode_values(a) + FLOOR) / (two.decode_values(b) + FLOOR)))
        for a, b in zip(*members, strict=True)
    ]
    assert np.median(off) < 5e-5
    # components are kept in half precision: a step of theirs, 0.004 at most, times a coordinate
    assert np.max(off) < 0.02
    spaces = [TraitSpace.from_arrays(b) for b in (made, other)]
    (one, two), (likely, as_likely) = (
        [np.array([f(space, z) for z in some]) for space, some in zip(spaces, members, strict=True)]
        for f in (TraitSpace.scores, TraitSpace.plausibility)
    )
    assert np.median(np.abs(one - two)) < 5e-4
    np.testing.assert_allclose(one, two, atol=0.05)
    np.testing.assert_allclose(likely, as_likely, atol=0.02)
    np.testing.assert_allclose(spaces[0].related, spaces[1].related, atol=0.02)


def assert_same_descriptors(made, other):
    """Numbers or columns by name are the same; colours by their a* and b*: a grey has no hue."""
    assert set(made) == set(other)
    rest = set(made)
    for kind in ("diffuse", "specular"):
        names = chroma, hue = f"{kind}_chroma", f"{kind}_hue"
        one, two = (d[chroma] * np.exp(1j * np.radians(d[hue])) for d in (made, other))
        assert np.max(np.abs(one - two)) < 0.01  # a hundredth of what an eye tells apart
        rest -= set(names)
    for name in rest:
        np.testing.assert_allclose(made[name], other[name], rtol=1e-4, atol=2e-5, err_msg=name)


@pytest.mark.slow
def test_the_recipe_makes_what_the_package_ships():
    assert_same_build(build(), artifact())


def test_what_the_package_ships():
    shipped = artifact()
    path = ROOT / "traitbrdf" / "data" / "library.npz"
    assert path.stat().st_size < 8e6
    assert all(value.dtype.kind in "fiuU" for value in shipped.values())
    assert all(np.isfinite(v).all() for v in shipped.values() if v.dtype.kind == "f")
    count = len(shipped["names"])
    assert count == packing.COUNT
    assert shipped["coordinates"].shape == (count, 24)
    assert shipped["labels"].shape == (len(shipped["trait_names"]), count)
    np.testing.assert_array_equal(shipped["low"], shipped["coordinates"].min(axis=0))
    np.testing.assert_array_equal(shipped["high"], shipped["coordinates"].max(axis=0))
    recipe = list(materials(packing.SEED, count))
    assert [m.name for m in recipe] == shipped["names"].tolist()
    assert [m.family for m in recipe] == shipped["families"].tolist()
    assert int(shipped["seed"]) == packing.SEED
    library = default_library()
    assert [json.dumps(m.parameters) for m in recipe] == [json.dumps(p) for p in library.parameters]
    for i in range(0, count, 170):  # descriptors are those of the members' own tables
        kept = {name: column[i] for name, column in library.descriptors.items()}
        assert_same_descriptors(descriptors(table_of(recipe[i], GRID)), kept)
    for row in shipped["labels"]:  # a third has it, a third has it not
        assert abs(np.mean(row == 1) - 1 / 3) < 0.01
        assert abs(np.mean(row == -1) - 1 / 3) < 0.01


@pytest.fixture(scope="module")
def small():
    told = []
    arrays = build(30, seed=3, components=(4, 4), progress=lambda *news: told.append(news))
    return arrays, told


def test_a_build_is_deterministic(small):
    again = build(30, seed=3, components=(4, 4))
    assert list(again) == list(small[0])
    for name, value in small[0].items():
        np.testing.assert_array_equal(again[name], value, err_msg=name)


def test_a_build_tells_its_progress(small):
    arrays, told = small
    assert arrays["coordinates"].shape == (30, 12)
    assert [fraction for stage, fraction in told if stage == "tabulating"][-1] == 1.0
    assert told[-1] == ("traits", 1.0)
    assert all(0.0 <= fraction <= 1.0 for _, fraction in told)


def test_a_build_can_be_used(small):
    embedding = BRDFEmbedding.from_arrays(small[0])
    space = TraitSpace.from_arrays(small[0])
    z = embedding.clip(small[0]["coordinates"][5])
    moved = space.move(z, {"bright": 0.2})
    assert embedding.decode(moved).max_albedo() <= 1.0 + 1e-3


def test_another_seed_makes_other_materials():
    drawn = [[m.name for m in materials(seed, 150)] for seed in (0, 1)]
    assert drawn[0] != drawn[1]


def test_the_documented_families_are_those_of_the_recipe():
    text = (ROOT / "docs" / "library.md").read_text()
    assert f"{packing.COUNT:,} materials of {len(FAMILIES)} families" in text
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| ")][1:]
    named = [name.strip() for row in rows for name in row.split(",")]
    assert sorted(named) == sorted(FAMILIES)


# -- other processors -------------------------------------------------------------------------


def elsewhere():
    """Settings by name that make libraries take instructions which another processor has."""
    has = np._core._multiarray_umath.__cpu_features__
    two = {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    some = {"one-thread": dict.fromkeys(two, "1"), "two-threads": two}
    simd = np.show_config("dicts")["SIMD Extensions"].get("found", [])
    if simd:
        some["plain-numpy"] = {"NPY_DISABLE_CPU_FEATURES": ",".join(simd)}
    if has.get("SSE3"):  # an x86 processor, of which OpenBLAS has kernels for many
        some["plain-libm"] = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"}
        kernels = {"Nehalem": "SSE42", "Haswell": "AVX2", "SkylakeX": "AVX512_SKX"}
        for kernel, needs in kernels.items():
            if has.get(needs):
                some[kernel] = {"OPENBLAS_CORETYPE": kernel}
        some["all-plain"] = {
            **some["one-thread"], **some.get("plain-numpy", {}), **some["plain-libm"],
            "OPENBLAS_CORETYPE": "Prescott", "ATEN_CPU_CAPABILITY": "default",
            "MKL_CBWR": "COMPATIBLE",
        }  # fmt: skip
    return some


ELSEWHERE = elsewhere()


def run_elsewhere(setting, script, *arguments):
    """What a script prints in a process under one of the settings."""
    call = [sys.executable, "-W", "error", "-c", script, *arguments]
    environment = {**os.environ, **ELSEWHERE[setting]}
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


OTHERS = (1, 1000)
"""Seed and number of members that are not shipped; enough that some differ without rounding."""


@pytest.fixture(scope="module")
def drawn_here():
    """Metals and members: those that are shipped, and others."""
    library = default_library()
    shipped = zip(library.names, library.families, library.parameters, strict=True)
    others = ((m.name, m.family, m.parameters) for m in materials(*OTHERS))
    return json.loads(json.dumps([dict(METALS), [*shipped, *others]]))


@pytest.mark.parametrize("setting", ELSEWHERE)
def test_the_recipe_is_the_same_on_every_processor(drawn_here, setting):
    script = f"""
import json
from traitbrdf.recipes.looks import METALS
from traitbrdf.recipes.materials import materials
from data_gen.packing import COUNT, SEED
drawn = [*materials(SEED, COUNT), *materials{OTHERS}]
print(json.dumps([dict(METALS), [(m.name, m.family, m.parameters) for m in drawn]]))
"""
    metals, drawn = json.loads(run_elsewhere(setting, script))
    assert metals == drawn_here[0]
    for one, other in zip(drawn, drawn_here[1], strict=True):
        assert one == other


def test_the_last_digit_of_what_a_processor_reckons_does_not_matter(drawn_here, monkeypatch):
    """Not even on processors of which no setting tells: any last digit may be another."""
    rng = np.random.default_rng(0)

    def unsure(function):
        def near(*arguments, **options):
            value = np.asarray(function(*arguments, **options))
            off = np.nextafter(value, rng.choice([-np.inf, np.inf], value.shape))
            return off if off.shape else float(off)

        return near

    class Generator:
        def __init__(self, seed):
            own = np.random.Generator(np.random.PCG64(seed))
            self.random, self.choice, self.integers = own.random, own.choice, own.integers
            self.uniform, self.normal = unsure(own.uniform), unsure(own.normal)

    monkeypatch.setattr(np.random, "default_rng", Generator)
    for name in ("exp", "log"):
        monkeypatch.setattr(math, name, unsure(getattr(math, name)))
    for module in (families, spectra):
        monkeypatch.setattr(module, "fresnel_conductor", unsure(fresnel_conductor))
    assert {name: spectra.indices.__wrapped__(name) for name in METALS} == dict(METALS)
    drawn = [*materials(packing.SEED, packing.COUNT), *materials(*OTHERS)]
    for member, (name, family, parameters) in zip(drawn, drawn_here[1], strict=True):
        assert (member.name, member.family) == (name, family)
        assert json.loads(json.dumps(member.parameters)) == parameters


def test_parameters_have_few_digits():
    for member in materials(3, 340):
        for value in np.concatenate([np.ravel(v) for v in member.parameters.values()]):
            assert value == float(f"{value:.{DIGITS}g}")


@pytest.mark.slow
@pytest.mark.parametrize("setting", [s for s in ("Nehalem", "all-plain") if s in ELSEWHERE])
def test_a_fit_decodes_to_the_same_on_every_processor(small, tmp_path, setting):
    script = """
import sys
from pathlib import Path
from data_gen.packing import build
from traitbrdf.formats.files import write_arrays
write_arrays(Path(sys.argv[1]), build(30, seed=3, components=(4, 4)))
"""
    path = tmp_path / "elsewhere.npz"
    run_elsewhere(setting, script, str(path))
    assert_same_build(read_arrays(path), small[0])


# -- labels -----------------------------------------------------------------------------------


def test_descriptors_look_at_the_table_alone():
    for i, material in enumerate(materials(0, 60)):
        if i % 6:
            continue
        table = TabulatedBRDF.from_model(material.model, COARSE, material.name)
        renamed = TabulatedBRDF(COARSE, table.values.copy(), name="something else")
        assert descriptors(renamed) == descriptors(table)
        assert all(math.isfinite(v) for v in descriptors(table).values())


def test_traits_are_made_of_known_descriptors():
    names, weights = grading()
    assert set(names) <= set(DESCRIPTORS)
    assert weights.shape == (len(TRAITS), len(names))
    np.testing.assert_allclose(np.abs(weights).sum(axis=1), 1.0, atol=1e-9)
    everyday = [other for trait in TRAITS.values() for other in trait.synonyms]
    assert len(set(everyday)) == len(everyday)
    assert not set(everyday) & set(TRAITS)
    assert all(trait.meaning for trait in TRAITS.values())


def test_descriptors_say_what_they_say():
    def of(model):
        return descriptors(TabulatedBRDF.from_model(model, GRID))

    flat, dark = of(Lambert(0.6)), of(Lambert(0.05))
    assert flat["highlight"] == pytest.approx(0.0, abs=1e-3)
    assert flat["width"] == pytest.approx(math.log(math.pi / 4))
    assert flat["specular"] == pytest.approx(0.0, abs=0.01)
    assert flat["diffuse"] == pytest.approx(0.6, rel=0.01)
    assert flat["lightness"] == pytest.approx(0.6 ** (1 / 3), rel=0.01)
    assert flat["lightness"] > dark["lightness"]
    assert of(Lambert((0.6, 0.2, 0.2)))["red"] == pytest.approx(math.log(3.0), abs=0.05)
    assert of(Lambert((0.2, 0.2, 0.6)))["blue"] == pytest.approx(math.log(3.0), abs=0.05)
    smooth, rough = of(GGX(0.05, 1.5, 0.0)), of(GGX(0.4, 1.5, 0.0))
    assert smooth["width"] < rough["width"]
    assert smooth["highlight"] > rough["highlight"] > flat["highlight"]
    assert of(GGX(0.1, 0.2, 3.9))["specular"] > 0.8


def test_the_highlight_of_a_plastic_has_no_tint():
    red = (0.6, 0.1, 0.1)
    plastic = TabulatedBRDF.from_model(Plastic(red, 0.05, 1.5), GRID)
    metal = TabulatedBRDF.from_model(GGX(0.05, 0.2, 3.9, red), GRID)
    assert descriptors(plastic)["tint"] < 0.05 < descriptors(metal)["tint"]


def test_labels_are_thirds():
    values = np.random.default_rng(0).normal(size=300)
    marks = labels(values)
    assert marks.dtype == np.int8
    assert [np.count_nonzero(marks == m) for m in (-1, 0, 1)] == [100, 100, 100]
    assert values[marks == 1].min() > values[marks == 0].max()
    assert values[marks == 0].min() > values[marks == -1].max()


# -- the command ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_as_a_process(tmp_path):
    out = tmp_path / "library.npz"
    shipped = (ROOT / "traitbrdf" / "data" / "library.npz").read_bytes()
    call = [sys.executable, "-W", "error", "-m", "data_gen", "--count", "40", "--out", str(out),
            "--tables", str(tmp_path / "tables")]  # fmt: skip
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "40 materials, 24 coordinates" in done.stdout
    assert len(read_arrays(out)["names"]) == 40
    assert (ROOT / "traitbrdf" / "data" / "library.npz").read_bytes() == shipped


def test_an_interruption_leaves_no_file(tmp_path, monkeypatch, capsys):
    def interrupted(count, seed, components, progress, folder, workers):
        def stop(stage, fraction):
            progress(stage, fraction)
            raise KeyboardInterrupt

        return build(count, seed, components, stop, folder, workers)

    monkeypatch.setattr(command, "build", interrupted)
    call = ["--count", "40", "--out", str(tmp_path / "a.npz"), "--tables", str(tmp_path / "t")]
    assert command.main(call) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["t"]
    assert "interrupted; " in capsys.readouterr().err


class EnoughError(Exception):
    pass


def test_tables_go_on_where_they_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "PIECE", 8)

    def stop(stage, fraction):
        if fraction >= 0.5:
            raise EnoughError

    some = tables.Tables(tmp_path / "some", 30, 3, COARSE)
    with pytest.raises(EnoughError):
        some.make(progress=stop)
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "some").iterdir()}
    assert len(made) == 2
    told = []
    some = tables.Tables(tmp_path / "some", 30, 3, COARSE)
    some.make(progress=lambda *news: told.append(news))
    assert told == [("tabulating", f) for f in (0.5, 0.75, 1.0)]
    assert all(path.stat().st_mtime_ns == time for path, time in made.items())
    whole = tables.Tables(tmp_path / "whole", 30, 3, COARSE)
    whole.make()
    assert len(whole) == 30
    for a, b, m in zip(some, whole, materials(3, 30), strict=True):
        assert a.name == b.name == m.name
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.values, tables.table_of(m, COARSE).values)
    assert whole.missing() == []
    # another seed and another grid are other tables
    assert len(tables.Tables(tmp_path / "whole", 30, 4, COARSE).missing()) == 4
    assert len(tables.Tables(tmp_path / "whole", 30, 3, HalfDiffGrid(9, 4, 3)).missing()) == 4
    whole.remove()
    assert not (tmp_path / "whole").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the cluster's own warnings are not ours
def test_workers_make_the_same_tables(tmp_path, monkeypatch):
    one = tables.Tables(tmp_path / "one", 100, 0, COARSE)
    one.make()
    two = tables.Tables(tmp_path / "two", 100, 0, COARSE)
    two.make(workers=2)
    assert two.missing() == []
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.values, b.values)


def test_a_stretch_of_the_recipe_is_that_of_the_whole():
    whole = list(materials(5, 140))
    for start, stop in ((0, 30), (30, 80), (64, 66), (100, 140)):
        assert list(materials(5, stop, start)) == whole[start:stop]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--count", "1"], "tables: expected at least two"),
        (["--count", "0"], "tables: expected at least two"),
        (["--count", "-1"], "count"),
        (["--seed", "-1"], "seed"),
        (["--count", "4", "--components", "0", "1"], "n_components"),
        (["--count", "4", "--components", "4", "1"], "n_components"),
    ],
)
def test_one_readable_line_for_a_mistake(tmp_path, capsys, arguments, match):
    out = tmp_path / "library.npz"
    assert command.main([*arguments, "--out", str(out), "--tables", str(tmp_path / "t")]) == 1
    told = capsys.readouterr().err.strip().splitlines()
    assert told[-1].startswith("data_gen: ")
    assert match in told[-1]
    assert not out.exists()


def test_a_folder_that_is_not_there(tmp_path, capsys, monkeypatch, small):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "build", lambda *arguments: small[0])
    assert command.main(["--out", str(tmp_path / "nowhere" / "library.npz")]) == 1
    assert "data_gen: " in capsys.readouterr().err
    assert command.main(["--components", "4", "4", "--out", str(tmp_path / "library.npz")]) == 0
    assert "30 materials" in capsys.readouterr().out


def test_wrong_usage_and_help(capsys):
    with pytest.raises(SystemExit) as wrong:
        command.main(["--count", "many"])
    assert wrong.value.code == 2
    with pytest.raises(SystemExit) as asked:
        command.main(["--help"])
    assert asked.value.code == 0
    assert "--count" in capsys.readouterr().out


# -- the study --------------------------------------------------------------------------------


def test_candidates_are_told_apart():
    """Held-out members alone: more numbers err less, and every kind of candidate runs."""
    few, more = (study.Candidate(components=c, grid=COARSE) for c in ((2, 1), (8, 4)))
    others = [
        study.Candidate("cube root", "channel", (4,), "even", COARSE),
        study.Candidate("log-relative", "together", (12,), grid=COARSE),
        study.Candidate("log1p twice", components=(4, 2), grid=COARSE),
        study.Candidate(components=(5, 1), grid=COARSE, charts=2),
    ]
    told = []
    rows = list(
        study.study([few, more, *others], 102, None, progress=lambda *news: told.append(news))
    )
    errors = [result["held out"] for _, result in rows]
    assert errors[1] < 0.7 * errors[0]
    assert all(0.0 < e < 1.0 for e in errors)
    assert [c.numbers for c, _ in rows] == [4, 16, 12, 12, 8, 8]
    assert told[-1] == ("comparing", 1.0)
    lines = study.table(rows).splitlines()
    assert len(lines) == 8
    assert f"| 8+4 | 16 | cosine | 45x12x5 | 1 | {errors[1]:.3f} |" in lines[3]


def test_mappings_go_there_and_back():
    f = np.array([[0.0, 1e-4, 0.02, 1.0, 30.0]])
    w, b = np.linspace(0.2, 1.0, 5), np.linspace(0.01, 1.0, 5)
    for forward, back in study._MAPPINGS.values():
        np.testing.assert_allclose(back(forward(f, w, b), w, b), f, rtol=1e-9, atol=1e-12)


def test_spaces_hold_what_they_were_fitted_to():
    """Materials of as many shapes as a space has numbers come back."""
    models = [Lambert((0.2, 0.4, 0.3)), GGX(0.2, 1.5, 0.0), GGX(0.5, (0.2, 0.9, 1.5), 3.0)]
    tables = [TabulatedBRDF.from_model(m, COARSE).values.reshape(-1, 3).T for m in models]
    known = np.stack(tables).astype(np.float32)
    seen = COARSE.above_horizon.ravel()
    angles = tuple(a.ravel()[seen] for a in COARSE.node_angles())
    one = MeasuredSet("own", angles, {"ggx": known[2][:, seen].T.astype(np.float64)})
    candidate = study.Candidate(colour="together", components=(2,), grid=COARSE)
    ((error, f),) = study.Charts(candidate, known).encode(one)
    assert np.median(error) < 0.02
    assert f.shape == (3, COARSE.size)
    assert np.all(f >= 0.0)
    # what looks alike is alike: the same to itself, and the less the more it is changed
    spheres = study.Spheres([EnvironmentMap.sky(rows=16)], 16)
    true, near, far = (spheres.images(COARSE, [c * f]) for c in (1.0, 1.05, 1.5))
    results = [spheres.compare(true, shown) for shown in (true, near, far)]
    psnr, flip = ([r[name] for r in results] for name in ("PSNR, dB", "FLIP"))
    assert psnr[0] > 90.0 > psnr[1] > psnr[2]
    assert flip[0] == 0.0 < flip[1] < flip[2] < 1.0


def test_the_documented_traits_are_those_of_the_package():
    text = (ROOT / "docs" / "traits.md").read_text()
    rows = [line for line in study.trait_table().splitlines() if line.startswith("| ")]
    for row in rows:  # but for the last digit of a number, elsewhere fitted a little otherwise
        assert " | ".join(row.split(" | ")[:4]) in text
    assert len(rows) == len(TRAITS) + 1
