"""Transport: rows against the oracle, frames against rows, and errors that are told."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from traitbrdf import reference, transport
from traitbrdf.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.directions import reflect
from traitbrdf.embedding import GRID, default_library
from traitbrdf.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.measured import MeasuredBRDF
from traitbrdf.models import GGX, AshikhminShirley, Lambert
from traitbrdf.scene import Camera, Scene
from traitbrdf.shapes import sphere, teapot
from traitbrdf.transport import Operator, Training, Transport, training_tables

LIBRARY = default_library()
NAMES = ("chrome", "blue-plastic", "green-felt", "red-rubber", "gold-satin")


def flat(table):
    """(cells, 3) of a table on the grid."""
    return np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)


def from_rows(rows, tables):
    """(m, B, 3) radiance by rows (m, 3, cells) in float64."""
    columns = np.stack([flat(t) for t in tables], axis=1).astype(np.float64)
    return np.einsum("pck,kbc->pbc", rows.astype(np.float64), columns, optimize=True)


def some(scene, count, seed=0):
    return np.random.default_rng(seed).choice(len(scene.pixels), count, replace=False)


def shade(built, table, part=0):
    return built.shade(part, torch.from_numpy(flat(table)[built.cells]))


def exactly(built, tables):
    """(P, 3) radiance of part 0 for each table, by the rows of all pixels, made once."""
    columns = torch.from_numpy(np.stack([flat(t) for t in tables], axis=-1).transpose(1, 0, 2))
    pixels = np.arange(len(built.scene.pixels))[built.scene.part_slice(0)]
    images = built.operator.images(pixels, columns.contiguous())
    return [images[..., i].T for i in range(len(tables))]


def relative(frame, exact):
    return float((frame.radiance - exact).abs().mean() / exact.mean())


@pytest.fixture(scope="module")
def built(small_sphere, training):
    return Transport(small_sphere, GRID, training, rank=24)


@pytest.fixture(scope="module")
def outsiders():
    """Tables unlike anything that the bases are trained with."""
    noise = np.random.default_rng(5).normal(size=(*GRID.shape, 3))
    bands = np.zeros((*GRID.shape, 3), np.float32)
    bands[20:24], bands[50:54] = 1.0, 2.0
    narrow = TabulatedBRDF.from_model(AshikhminShirley(0.0, 0.9, 2.0, 9e3), GRID)
    return [
        TabulatedBRDF(GRID, np.exp(noise).astype(np.float32), name="noise"),
        TabulatedBRDF(GRID, bands, name="bands"),
        TabulatedBRDF(GRID, narrow.values, name="streaks"),
    ]


# -- rows -------------------------------------------------------------------------------------


def test_rows_against_the_oracle(small_teapot):
    """Sharp and rough tables under a map and two lights beside it, on random pixels."""
    scene = small_teapot
    tables = [LIBRARY[name] for name in NAMES]
    tables += [TabulatedBRDF.from_model(m, GRID) for m in (GGX(0.01, 1.5, 0.0), Lambert(0.5))]
    index = some(scene, 12)
    true, own_error = reference.radiance(
        scene.normals[index], scene.views[index], tables, scene.environment, scene.lights,
        scene.positions[index], tolerance=1e-3,
    )  # fmt: skip
    shown = from_rows(Operator(scene, GRID).rows(index), tables)
    level = true.mean(axis=(0, 2))
    assert np.all(np.abs(shown - true).mean(axis=(0, 2)) < 0.003 * level)
    assert np.all(np.abs(shown - true) < 0.01 * true + 3.0 * own_error)


def test_lights_alone(small_sphere):
    """Without a map a row is the table's own eval: exact."""
    lights = [PointLight((2.0, 3.0, 2.0), (40.0, 30.0, 20.0)), DirectionalLight((0.0, 1.0, 0.3))]
    dark = EnvironmentMap(np.zeros((4, 8, 3)))
    scene = Scene(sphere(), dark, lights, small_sphere.camera, size=24)
    tables = [LIBRARY[name] for name in NAMES]
    index = some(scene, 40)
    true, _ = reference.radiance(
        scene.normals[index], scene.views[index], tables, None, lights, scene.positions[index]
    )
    np.testing.assert_allclose(
        from_rows(Operator(scene, GRID).rows(index), tables), true, rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("light", ["sky", "turned", "uniform", "one texel", "studio", "night"])
def test_a_lambert_surface_sees_the_irradiance(light, small_sphere, request):
    environment = {
        "sky": lambda: EnvironmentMap.sky(rows=64),
        "turned": lambda: EnvironmentMap.sky(rows=32).rotated(2.0),
        "uniform": lambda: EnvironmentMap.uniform((0.5, 1.0, 2.0), rows=128),
        "one texel": lambda: EnvironmentMap(np.eye(512)[77].reshape(16, 32, 1) * np.ones(3)),
    }.get(light) or (
        lambda: EnvironmentMap.read(
            request.getfixturevalue("shared_data") / "envmaps" / f"{light}.exr"
        )
    )
    scene = Scene(sphere(), environment(), camera=small_sphere.camera, size=48)
    index = some(scene, 150)
    grey = torch.full((3, GRID.size, 1), 1.0 / math.pi)
    shown = Operator(scene, GRID).images(index, grey)[..., 0].T.numpy()
    true = scene.environment.irradiance(scene.normals[index]) / math.pi
    # the sum over texels is exact where the horizon cuts none
    whole = true[:, 1] > 0.3 * true[:, 1].max() if light == "one texel" else slice(None)
    assert np.abs(shown - true)[whole].mean() < 1e-3 * true[whole].mean()


def test_a_uniform_map_is_the_albedo(small_sphere):
    """Under radiance 1 from everywhere a pixel shows the directional albedo of its table."""
    scene = Scene(sphere(), EnvironmentMap.uniform(rows=32), camera=small_sphere.camera, size=48)
    cos = np.sum(scene.normals * scene.views, axis=-1)
    index = np.flatnonzero(cos > math.cos(math.radians(75.0)))[::40]
    shown = from_rows(Operator(scene, GRID).rows(index), [LIBRARY[n] for n in NAMES])
    for i, name in enumerate(NAMES):
        true = LIBRARY[name].albedo(np.arccos(cos[index]))
        np.testing.assert_allclose(shown[:, i], true, rtol=0.01)


def test_rows_are_linear_in_the_light(small_sphere):
    sky = EnvironmentMap.sky(rows=32, sun=None)
    sun = EnvironmentMap.sky(rows=32, softboxes=False)
    both = EnvironmentMap(sky.image + sun.image)
    index = some(small_sphere, 12)

    def radiance(environment):
        scene = Scene(sphere(), environment, camera=small_sphere.camera, size=36)
        return from_rows(Operator(scene, GRID).rows(index), [LIBRARY[n] for n in NAMES])

    np.testing.assert_allclose(radiance(sky.scaled(4.0)), 4.0 * radiance(sky), rtol=1e-5)
    together, apart = radiance(both), radiance(sky) + radiance(sun)
    assert np.abs(together - apart).mean() < 0.003 * together.mean()


def test_turning_everything_changes_nothing():
    """The map, the lights and the camera turned about +y together."""
    index = np.arange(0, 500, 50)
    shown = []
    for turn in (0.0, 0.9):
        c, s = math.cos(turn), math.sin(turn)
        lights = [
            DirectionalLight((0.6 * c + 0.8 * s, 1.0, 0.8 * c - 0.6 * s)),
            PointLight((3.0 * s, 3.0, 3.0 * c), (9.0, 9.0, 9.0)),
        ]
        scene = Scene(sphere(), EnvironmentMap.sky(rows=32).rotated(turn), lights,
                      Camera(math.degrees(turn), 15.0), size=32)  # fmt: skip
        shown.append(from_rows(Operator(scene, GRID).rows(index), [LIBRARY[n] for n in NAMES]))
    np.testing.assert_allclose(shown[1], shown[0], rtol=2e-3, atol=1e-6)


def test_chunks_do_not_show(small_sphere, monkeypatch):
    operator = Operator(small_sphere, GRID)
    index = some(small_sphere, 50)
    tables = torch.from_numpy(np.ascontiguousarray(flat(LIBRARY["chrome"]).T[:, :, None]))
    whole = operator.images(index, tables)
    monkeypatch.setattr(transport, "_ROWS_AT_ONCE", 7)
    torch.testing.assert_close(operator.images(index, tables), whole, rtol=1e-5, atol=1e-6)
    assert operator.images(index[:0], tables).shape == (3, 0, 1)
    assert operator.rows(index[:0]).shape == (0, 3, GRID.size)


# -- frames -----------------------------------------------------------------------------------


def test_frames_of_library_members(built):
    tables = [LIBRARY[name] for name in LIBRARY.names[3::20]]  # the bases know every sixth
    frames = [shade(built, table) for table in tables]
    exact = exactly(built, tables)
    errors = [relative(f, e) for f, e in zip(frames, exact, strict=True)]
    measured = [f.error for f in frames]
    print(f"24 images, members: mean relative L1 median {np.median(errors):.4f}, "
          f"worst {max(errors):.4f}; measured {np.median(measured):.4f}")  # fmt: skip
    assert np.median(errors) < 0.01
    assert max(errors) < 0.05
    assert 0.3 * np.median(errors) < np.median(measured) < 3.0 * np.median(errors)


def test_the_measured_error_is_honest(built, outsiders):
    for table, exact in zip(outsiders, exactly(built, outsiders), strict=True):
        frame = shade(built, table)
        true = relative(frame, exact)
        assert true / 3.0 < frame.error < 10.0 * true, table.name
        assert frame.error > 0.01, table.name


def test_the_measured_error_is_honest_on_measured_materials(built, shared_data):
    paths = sorted((shared_data / "rgl").glob("*.bsdf"))[:4]
    tables = [TabulatedBRDF.from_model(MeasuredBRDF.read(path), GRID) for path in paths]
    for path, table, exact in zip(paths, tables, exactly(built, tables), strict=True):
        frame = shade(built, table)
        true = relative(frame, exact)
        assert true / 3.0 < frame.error < 10.0 * true, path.name


def test_more_basis_images_err_less(small_sphere, training, built):
    few = Transport(small_sphere, GRID, training, rank=6)
    tables = [LIBRARY[name] for name in NAMES]
    exact = exactly(built, tables)
    worse = [relative(shade(few, t), e) for t, e in zip(tables, exact, strict=True)]
    better = [relative(shade(built, t), e) for t, e in zip(tables, exact, strict=True)]
    assert np.mean(better) < 0.5 * np.mean(worse)


def test_a_frame_is_proportional_to_its_table(built):
    table = flat(LIBRARY["blue-plastic"])[built.cells]
    once, thrice = (built.shade(0, torch.from_numpy(f * table)) for f in (1.0, 3.0))
    torch.testing.assert_close(thrice.radiance, 3.0 * once.radiance, rtol=1e-4, atol=1e-6)
    assert thrice.error == pytest.approx(once.error, rel=1e-3)


def test_the_exact_frame_is_the_operator_s(built):
    frame = built.shade_exactly(0, flat(LIBRARY["chrome"]))
    torch.testing.assert_close(frame.radiance, exactly(built, [LIBRARY["chrome"]])[0])
    assert frame.error == 0.0
    assert frame.level == pytest.approx(float(frame.radiance.mean()))


def test_frames_are_never_negative(built, outsiders):
    for table in [*outsiders, LIBRARY["chrome"], LIBRARY["black-velvet"]]:
        assert float(shade(built, table).radiance.min()) >= 0.0
    black = built.shade(0, torch.zeros((len(built.cells), 3)))
    assert float(black.radiance.abs().max()) == 0.0
    assert black.error == 0.0


def test_a_perfect_mirror_shows_the_map(built, small_sphere):
    weight = torch.tensor([1.0, 0.5, 0.25])
    scene = small_sphere
    seen = scene.environment.radiance(reflect(scene.views, scene.normals))
    black = torch.zeros((len(built.cells), 3))
    frame = built.shade(0, black, weight)
    np.testing.assert_allclose(frame.radiance, seen * weight.numpy(), rtol=1e-6)
    exact = built.shade_exactly(0, np.zeros((GRID.size, 3), np.float32), weight)
    torch.testing.assert_close(exact.radiance, frame.radiance)


def test_composed_frames(built, small_sphere):
    scene = small_sphere
    frame = shade(built, LIBRARY["gold-satin"])
    image = built.compose([frame])
    assert image.shape == (scene.height, scene.width, 3)
    pixels = image.reshape(-1, 3).numpy()
    np.testing.assert_array_equal(pixels[scene.pixels], frame.radiance.numpy())
    outside = np.setdiff1d(np.arange(len(pixels)), scene.pixels)
    np.testing.assert_array_equal(pixels[outside], scene.backdrop().reshape(-1, 3)[outside])
    assert built.frame_error([frame]) == pytest.approx(frame.error)


def test_what_a_build_holds(built):
    assert built.bytes > 0
    assert built.rank == 24
    assert np.all(np.diff(built.cells) > 0)
    assert 0 < len(built.cells) <= GRID.size
    q = built.parts[0].basis
    # orthonormal but for the pixels that were damped, where it is larger: no image got lost
    assert torch.isfinite(q).all()
    assert ((q**2).sum(dim=-1) > 0.999).all()
    for c in range(3):
        assert torch.linalg.matrix_rank(q[c]) == q.shape[1]


def test_cells_that_nobody_sees_do_not_count(built):
    table = flat(LIBRARY["blue-plastic"])
    changed = np.zeros_like(table)
    changed[built.cells] = table[built.cells]
    other = TabulatedBRDF(GRID, changed.reshape(*GRID.shape, 3))
    whole, seen = exactly(built, [LIBRARY["blue-plastic"], other])
    # cells that only pixels outside the fit touch are few
    assert float((seen - whole).abs().mean()) < 0.01 * float(whole.mean())


# -- corners ----------------------------------------------------------------------------------


def test_no_light_is_black(training):
    scene = Scene(sphere(), EnvironmentMap(np.zeros((4, 8, 3))), size=16)
    black = Transport(scene, GRID, training, rank=8)
    frame = shade(black, LIBRARY["chrome"])
    assert float(frame.radiance.abs().max()) == 0.0
    assert frame.error == 0.0
    assert float(black.compose([frame]).abs().max()) == 0.0
    assert math.isfinite(black.frame_error([frame]))


def test_light_of_one_colour(training):
    red = EnvironmentMap(EnvironmentMap.sky(rows=16).image * np.array([1.0, 0.0, 0.0], np.float32))
    built = Transport(Scene(sphere(), red, size=20), GRID, training, rank=12)
    frame = shade(built, LIBRARY["blue-plastic"])
    assert torch.isfinite(frame.radiance).all()
    assert float(frame.radiance[:, 1:].abs().max()) == 0.0
    assert float(frame.radiance[:, 0].max()) > 0.0
    assert frame.error < 0.05


def test_a_uniform_map_has_few_dimensions(training):
    """Every pixel of a view angle looks the same: most of the basis vanishes."""
    scene = Scene(sphere(), EnvironmentMap.uniform(rows=32), size=24)
    built = Transport(scene, GRID, training, rank=64)
    tables = [LIBRARY[name] for name in NAMES]
    for table, exact in zip(tables, exactly(built, tables), strict=True):
        frame = shade(built, table)
        assert torch.isfinite(frame.radiance).all()
        assert relative(frame, exact) < 0.02
    white = shade(built, TabulatedBRDF.from_model(Lambert(1.0), GRID))
    torch.testing.assert_close(
        white.radiance, torch.ones_like(white.radiance), rtol=0.02, atol=0.02
    )


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_few_pixels(size, training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=16), size=size)
    built = Transport(scene, GRID, training, rank=24)
    tables = [LIBRARY[name] for name in NAMES]
    for table, exact in zip(tables, exactly(built, tables), strict=True):
        frame = shade(built, table)
        assert frame.radiance.shape == (len(scene.pixels), 3)
        assert torch.isfinite(frame.radiance).all()
        assert math.isfinite(frame.error)
        if len(scene.pixels) < 4:  # nothing is kept apart, and nothing is lost
            assert relative(frame, exact) < 1e-3
    assert built.compose([shade(built, LIBRARY["chrome"])]).shape == (size, size, 3)


def test_parts_of_a_few_pixels_and_of_none(training):
    camera = Camera.orbit(0.0, 90.0)  # from above: no bottom
    scene = Scene(teapot(), EnvironmentMap.sky(rows=16), camera=camera, size=12)
    counts = [len(scene.pixels[scene.part_slice(i)]) for i in range(len(scene.parts))]
    assert min(counts) == 0
    assert any(1 <= n <= 10 for n in counts)
    built = Transport(scene, GRID, training, rank=24)
    table = LIBRARY["red-rubber"]
    frames = [shade(built, table, i) for i in range(len(scene.parts))]
    exact = [built.shade_exactly(i, flat(table)) for i in range(len(scene.parts))]
    for count, frame, true in zip(counts, frames, exact, strict=True):
        assert frame.radiance.shape == true.radiance.shape == (count, 3)
        assert torch.isfinite(frame.radiance).all()
        if count == 0:
            assert built.shade_exactly(counts.index(0), flat(table), torch.ones(3)).error == 0.0
            assert frame.error == true.error == frame.level == true.level == 0.0
        elif count > 40:
            assert relative(frame, true.radiance) < 0.05
    assert torch.isfinite(built.compose(frames)).all()


def test_an_empty_scene(training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=8),
                  camera=Camera(target=(50.0, 0.0, 0.0), zoom=20.0), size=8)  # fmt: skip
    built = Transport(scene, GRID, training, rank=8)
    assert len(built.cells) == 0
    frame = built.shade(0, torch.zeros((0, 3)))
    np.testing.assert_array_equal(built.compose([frame]).numpy(), scene.backdrop())
    assert built.frame_error([frame]) == 0.0


# -- building ---------------------------------------------------------------------------------


def test_two_builds_are_bit_identical(small_sphere, training, built):
    again = Transport(small_sphere, GRID, training, rank=24)
    np.testing.assert_array_equal(again.cells, built.cells)
    for name in ("basis", "projection", "probe_rows", "probe_basis", "mirror"):
        assert torch.equal(getattr(again.parts[0], name), getattr(built.parts[0], name)), name
    table = LIBRARY["chrome"]
    assert torch.equal(shade(again, table).radiance, shade(built, table).radiance)


def test_the_seed_decides(training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=32), size=20)
    first, second = (Transport(scene, GRID, training, rank=8, seed=s) for s in (0, 1))
    assert not torch.equal(first.parts[0].probe_rows, second.parts[0].probe_rows)


def test_progress_is_told_and_can_cancel(training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=32), size=20)
    told = []
    Transport(scene, GRID, training, rank=8, progress=lambda *news: told.append(news))
    assert all(isinstance(stage, str) and 0.0 <= part <= 1.0 for stage, part in told)
    assert told[-1][1] == 1.0
    assert len({stage for stage, _ in told}) >= 2

    class CancelError(Exception):
        pass

    def cancel(stage, fraction):
        raise CancelError

    with pytest.raises(CancelError):
        Transport(scene, GRID, training, rank=8, progress=cancel)


def test_training_tables():
    grid = HalfDiffGrid(12, 6, 4)
    library = np.full((grid.size, 5), 0.3, np.float32)
    made = training_tables(library, grid, seed=1)
    assert made.tables.dtype == np.float32
    assert made.tables.shape == (grid.size, len(made.weight))
    assert np.isfinite(made.tables).all()
    assert made.tables.min() >= 0.0
    assert np.all(made.weight > 0.0)
    np.testing.assert_array_equal(made.tables[:, :5], library)
    again, other = training_tables(library, grid, seed=1), training_tables(library, grid, seed=2)
    np.testing.assert_array_equal(again.tables, made.tables)
    assert not np.array_equal(other.tables, made.tables)


@pytest.mark.parametrize("rank", [0, -1, 2.0, None, "8"])
def test_bad_ranks(rank, small_sphere, training):
    with pytest.raises(ValueError, match="rank"):
        Transport(small_sphere, GRID, training, rank=rank)


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf])
def test_bad_resolutions(resolution, small_sphere, training):
    with pytest.raises(ValueError, match="resolution"):
        Transport(small_sphere, GRID, training, resolution=resolution)


def test_bad_tables_and_grids(small_sphere, training, built):
    with pytest.raises(ValueError, match="training"):
        Transport(small_sphere, GRID, Training(training.tables[:-1], training.weight))
    with pytest.raises(ValueError, match="training"):
        Transport(small_sphere, GRID, Training(training.tables, training.weight[:-1]))
    with pytest.raises(ValueError, match="folded"):
        Operator(small_sphere, HalfDiffGrid(9, 9, 9, "merl"))
    with pytest.raises(ValueError, match="table"):
        built.shade(0, torch.zeros((7, 3)))
    with pytest.raises(ValueError, match="table"):
        built.shade_exactly(0, np.zeros((7, 3), np.float32))


def test_a_pixel_far_above_the_subset_does_not_fill_the_basis():
    # as at grazing views, or where one pixel of thousands mirrors the sun
    generator = torch.Generator().manual_seed(4)
    images = torch.randn(3, 2000, 16, generator=generator) / 300**0.5
    images[:, 1234] *= 1e5
    damping = transport._damping(images, subset=300)
    usual = torch.arange(2000) != 1234
    assert (damping[:, 1234] < 1e-3).all()
    assert (damping[:, usual] == 1.0).all()
    basis = transport._orthonormal(images * damping)
    norms = (basis**2).sum(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms), rtol=0.0, atol=1e-4)
