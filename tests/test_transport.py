"""Transport: frames against exact ones, measured errors, and what a preparation stores."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from traitbrdf import reference
from traitbrdf.directions import reflect
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.reflectance.models import AshikhminShirley, Lambert
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.space.embedding import GRID
from traitbrdf.space.library import default_library
from traitbrdf.transport.basis import Training, damping_of, leading, training_tables
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.lighttree import LightTree
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.transport import Transport

LIBRARY = default_library()
NAMES = ("chrome", "blue-plastic", "green-felt", "red-rubber", "gold-satin")
TABLES = [LIBRARY[name] for name in NAMES]


def flat(table):
    """Values (cells, 3) of a table on the grid."""
    return np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)


def seen(built, table):
    """Values (n, 3) of a table at the cells that the scene sees."""
    return torch.from_numpy(flat(table)[built.cells]).to(built.device)


def shade(built, table, part=0):
    return built.shade(part, seen(built, table))


def frames(built, table):
    return [shade(built, table, part) for part in range(len(built.scene.parts))]


def exactly(built, tables, part=0):
    """Radiance (P, 3) of a part for each table; each fragment has leaves of its own."""
    columns = np.concatenate([flat(t) for t in tables], axis=1)
    span = built.scene.part_slice(part)
    images = built.operator.images(np.arange(span.start, span.stop), columns)
    return [
        torch.from_numpy(np.einsum("pcc->pc", images[..., 3 * i : 3 * i + 3]).copy())
        for i in range(len(tables))
    ]


def relative(frame, exact):
    return float((frame.radiance - exact).abs().mean() / exact.mean())


def copied(built):
    """An equal transport; training it does not change the first."""
    # with the same operator, so that rays are cast once
    return Transport.restored(built.scene, GRID, built.arrays(), operator=built.operator)


def ball(size=32, rows=32, **settings):
    sky = EnvironmentMap.sky(rows=rows)
    settings = {"camera": Camera.orbit(20.0, 25.0), "ground": True, **settings}
    return Scene(sphere(), sky, size=size, **settings)


@pytest.fixture(scope="module")
def built(small_sphere, training):
    return Transport(small_sphere, GRID, training, rank=24)


@pytest.fixture(scope="module")
def on_ground(training):
    """A ball that casts shadows on the ground, under a map and two more lights."""
    lights = [
        PointLight(position=(3.0, 4.0, 3.0), intensity=(20.0, 18.0, 15.0)),
        DirectionalLight(direction=(-1.0, 2.0, 0.7), irradiance=(0.3, 0.4, 0.6)),
    ]
    return Transport(ball(lights=lights), GRID, training, rank=24)


@pytest.fixture(scope="module")
def outsiders():
    """Tables unlike all training tables."""
    noise = np.random.default_rng(5).normal(size=(*GRID.shape, 3))
    angle, _, _ = GRID.node_angles()
    rings = 0.02 + np.exp(-0.5 * (np.log(np.maximum(angle, 1e-3) / 0.3) / 0.4) ** 2)
    rings = np.broadcast_to(rings[..., None], (*GRID.shape, 3)).astype(np.float32)
    narrow = TabulatedBRDF.from_model(AshikhminShirley(0.0, 0.9, 2.0, 9e3), GRID)
    return [
        TabulatedBRDF(GRID, np.exp(noise).astype(np.float32), name="noise"),
        TabulatedBRDF(GRID, rings, name="rings"),
        TabulatedBRDF(GRID, narrow.values, name="streaks"),
    ]


# -- frames -----------------------------------------------------------------------------------


def test_frames_of_library_members(built):
    tables = [LIBRARY[name] for name in LIBRARY.names[3::40]]  # every sixth is a training table
    shown = [shade(built, table) for table in tables]
    exact = exactly(built, tables)
    errors = [relative(f, e) for f, e in zip(shown, exact, strict=True)]
    measured = [f.error for f in shown]
    print(f"24 images, members: mean relative L1 median {np.median(errors):.4f}, "
          f"worst {max(errors):.4f}; measured {np.median(measured):.4f}")  # fmt: skip
    assert np.median(errors) < 0.01
    assert np.quantile(errors, 0.9) < 0.05
    assert max(errors) < 0.1  # the worst are the most saturated flakes, at this low rank
    assert 0.3 * np.median(errors) < np.median(measured) < 3.0 * np.median(errors)


@pytest.mark.slow
def test_frames_against_the_oracle(on_ground):
    """Fragments of all kinds, in light and shadow, inside and at borders."""
    scene = on_ground.scene
    tables = [LIBRARY[name] for name in LIBRARY.names[3::20]]
    index = np.sort(np.random.default_rng(1).choice(len(scene.pixels), 60, replace=False))
    assert scene.bordering[index].any()
    true, _ = reference.fragments(scene, index, tables, 1e-3)
    shown = np.stack(
        [np.concatenate([f.radiance for f in frames(on_ground, t)])[index] for t in tables], axis=1
    )
    error = np.abs(shown - true).mean(axis=(0, 2)) / true.mean(axis=(0, 2))
    stated = [on_ground.frame_error(frames(on_ground, t)) for t in tables]
    print(f"frames: median {np.median(error):.4f}, worst {error.max():.4f}, "
          f"stated {np.median(stated):.4f}")  # fmt: skip
    assert np.median(error) < 0.015
    assert error.max() < 0.06
    assert np.median(error) / 3.0 < np.median(stated) < 3.0 * np.median(error)


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
    exact = exactly(built, TABLES)
    worse = [relative(shade(few, t), e) for t, e in zip(TABLES, exact, strict=True)]
    better = [relative(shade(built, t), e) for t, e in zip(TABLES, exact, strict=True)]
    assert np.mean(better) < 0.5 * np.mean(worse)


def test_a_frame_is_proportional_to_its_table(built):
    table = flat(LIBRARY["blue-plastic"])[built.cells]
    once, thrice = (built.shade(0, torch.from_numpy(f * table)) for f in (1.0, 3.0))
    torch.testing.assert_close(thrice.radiance, 3.0 * once.radiance, rtol=1e-4, atol=1e-6)
    assert thrice.error == pytest.approx(once.error, rel=1e-3)


def test_radiance_is_linear_and_differentiable(on_ground):
    first, second = (seen(on_ground, LIBRARY[name]) for name in ("chrome", "blue-plastic"))
    for part in range(2):
        one, two = on_ground.radiance(part, first), on_ground.radiance(part, second)
        level = float(one.abs().mean() + two.abs().mean())
        both = on_ground.radiance(part, 3.0 * first - 2.0 * second)
        torch.testing.assert_close(both, 3.0 * one - 2.0 * two, rtol=1e-3, atol=1e-4 * level)
        assert float(both.min()) < 0.0, "clamped"
        torch.testing.assert_close(
            on_ground.shade(part, first).radiance, one.clamp_min(0.0), rtol=1e-5, atol=1e-6 * level
        )
        weight = torch.rand(one.shape, generator=torch.Generator().manual_seed(part))
        table = first.clone().requires_grad_()
        (weight * on_ground.radiance(part, table)).sum().backward()
        # the derivative of a linear function along a direction is its value at that direction
        assert float((table.grad * second).sum()) == pytest.approx(
            float((weight * two).sum()), rel=1e-3
        )


def test_the_exact_frame_is_the_operator_s(built):
    chrome = flat(LIBRARY["chrome"])
    frame = built.shade_exactly(0, chrome)
    images = built.operator.part_images(0, chrome, interpolate=False)
    np.testing.assert_allclose(frame.radiance, np.einsum("pcc->pc", images), rtol=1e-6)
    # far images are interpolated, while the probes use finer leaves
    assert relative(frame, exactly(built, [LIBRARY["chrome"]])[0]) < 0.005
    assert 0.0 < frame.error < 0.01
    assert frame.level == pytest.approx(float(frame.radiance.mean()), rel=0.5)


def test_exact_frames_show_what_no_basis_does(built, outsiders):
    for table in outsiders:
        exact = built.shade_exactly(0, flat(table))
        assert exact.error < 0.5 * shade(built, table).error, table.name


def test_frames_are_never_negative(built, outsiders):
    for table in [*outsiders, LIBRARY["chrome"], LIBRARY["black-velvet"]]:
        assert float(shade(built, table).radiance.min()) >= 0.0
    black = built.shade(0, torch.zeros((len(built.cells), 3)))
    assert float(black.radiance.abs().max()) == 0.0
    assert black.error == 0.0


def test_a_perfect_mirror_shows_the_map(on_ground):
    scene = on_ground.scene
    weight = torch.tensor([1.0, 0.5, 0.25])
    sample, owner, share = scene.samples(np.arange(len(scene.pixels)))
    toward = reflect(scene.views, scene.normals)
    light = scene.environment.radiance(toward) * scene.visible(sample, toward)[:, None]
    shown = np.zeros((len(scene.pixels), 3))
    np.add.at(shown, owner, light * share[:, None])
    black = torch.zeros((len(on_ground.cells), 3))
    for part in range(2):
        frame = on_ground.shade(part, black, weight)
        expected = shown[scene.part_slice(part)] * weight.numpy()
        np.testing.assert_allclose(frame.radiance, expected, rtol=1e-5, atol=1e-9)
        zeros = np.zeros((GRID.size, 3), np.float32)
        exact = on_ground.shade_exactly(part, zeros, weight)
        torch.testing.assert_close(exact.radiance, frame.radiance)


def test_composed_frames(on_ground):
    """A pixel is the sum of its fragments and of the uncovered backdrop."""
    scene = on_ground.scene
    shown = frames(on_ground, LIBRARY["gold-satin"])
    image = on_ground.compose(shown)
    assert image.shape == (scene.height, scene.width, 3)
    expected = scene.backdrop().reshape(-1, 3) * scene.uncovered[:, None]
    np.add.at(expected, scene.pixels, np.concatenate([f.radiance for f in shown]))
    np.testing.assert_allclose(image.reshape(-1, 3), expected, rtol=1e-5)
    shared = np.bincount(scene.pixels, minlength=len(expected)) > 1
    assert shared.any()
    outside = np.setdiff1d(np.arange(len(expected)), scene.pixels)
    np.testing.assert_array_equal(
        image.reshape(-1, 3)[outside], scene.backdrop().reshape(-1, 3)[outside]
    )


def test_the_frame_s_error_is_its_parts(on_ground):
    shown = frames(on_ground, LIBRARY["gold-satin"])
    size = np.bincount(on_ground.scene.pixel_part)
    deviation = sum(n * f.deviation for n, f in zip(size, shown, strict=True))
    level = sum(n * f.level for n, f in zip(size, shown, strict=True))
    assert on_ground.frame_error(shown) == pytest.approx(deviation / level)
    assert min(f.error for f in shown) <= deviation / level <= max(f.error for f in shown)


@pytest.mark.parametrize("grey_light", [True, False])
def test_grey_light_takes_one_channel(grey_light, training, monkeypatch):
    """One channel gives the same frames as three, from a third of the numbers."""
    image = np.random.default_rng(3).uniform(0.1, 2.0, (16, 32, 1)) * np.ones(3)
    colour = (2.0, 2.0, 2.0) if grey_light else (2.0, 2.1, 2.0)
    lights = [DirectionalLight((0.3, 1.0, 0.5), colour)]
    scene = ball(20, lights=lights).changed(environment=EnvironmentMap(image))
    one = Transport(scene, GRID, training, rank=24)
    assert one.grey == grey_light
    assert len(one.arrays()["rows_0"]) == (1 if grey_light else 3)
    if not grey_light:
        return
    monkeypatch.setattr("traitbrdf.transport.transport.is_grey", lambda scene: False)
    three = Transport(scene, GRID, training, rank=24)
    assert 2.0 * one.bytes < three.bytes
    for table in TABLES:
        for part in range(2):
            exact = exactly(three, [table], part)[0]
            grey, coloured = (shade(built, table, part) for built in (one, three))
            assert relative(grey, exact) < max(0.01, 2.0 * relative(coloured, exact)), table.name
            assert relative(grey, coloured.radiance) < 0.02, table.name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_frames_on_cuda_are_those_of_the_cpu(on_ground):
    scene = on_ground.scene
    other = Transport.restored(scene, GRID, on_ground.arrays(), "cuda")
    mirror = torch.tensor([0.1, 0.2, 0.3])
    for table in TABLES:
        cpu = [on_ground.shade(p, seen(on_ground, table), mirror) for p in range(2)]
        gpu = [other.shade(p, seen(other, table), mirror.cuda()) for p in range(2)]
        assert all(f.radiance.is_cuda for f in gpu)
        expected = on_ground.compose(cpu)
        off = (other.compose(gpu).cpu() - expected).abs()
        assert float(off.mean()) < 1e-5 * float(expected.mean())
        assert float(off.max()) < 1e-4 * float(expected.max())
        assert other.frame_error(gpu) == pytest.approx(on_ground.frame_error(cpu), rel=0.01)
        exact = other.shade_exactly(0, flat(table), mirror.cuda())
        torch.testing.assert_close(
            exact.radiance.cpu(), on_ground.shade_exactly(0, flat(table), mirror).radiance
        )


# -- what a preparation stores ----------------------------------------------------------------


def test_what_a_build_holds(built, small_sphere):
    assert built.bytes > 0
    assert built.rank == 24
    assert np.all(np.diff(built.cells) > 0)
    assert 0 < len(built.cells) <= GRID.size
    q = torch.from_numpy(built.arrays()["basis_0"])
    # one basis serves the three colours
    assert 8 <= q.shape[1] <= 24
    assert q.shape[0] == len(small_sphere.pixels)
    # orthonormal except at damped pixels, where it is larger: no image is missing
    assert torch.isfinite(q).all()
    assert ((q**2).sum(dim=0) > 0.999).all()
    assert torch.linalg.matrix_rank(q) == q.shape[1]


def test_rays_are_cast_once(training):
    """A thread casts the rays of the next part while another part is shaded."""
    cast = []
    for _ in range(3):
        scene = ball(24)
        Transport(scene, GRID, training, rank=8)
        cast.append(scene.rays_cast)
    scene = ball(24)
    operator = Operator(scene, GRID)
    for part in range(len(scene.parts)):
        operator.prepare(part)
    assert cast[0] == cast[1] == cast[2]
    # the subset and the probes cast rays of their own
    assert scene.rays_cast < cast[0] < 20 * scene.rays_cast


def test_a_part_alone_reads_its_own_rows(on_ground):
    table = torch.from_numpy(flat(LIBRARY["gold-satin"])[on_ground.cells])
    for part in range(len(on_ground.parts)):
        alone = on_ground.shade(part, table.clone(), alone=True)
        beside = on_ground.shade(part, table.clone())
        torch.testing.assert_close(alone.radiance, beside.radiance, rtol=1e-4, atol=1e-6)
        assert alone.error == pytest.approx(beside.error, rel=1e-3)


def test_cells_that_nobody_sees_do_not_count(built):
    table = flat(LIBRARY["blue-plastic"])
    changed = np.zeros_like(table)
    changed[built.cells] = table[built.cells]
    other = TabulatedBRDF(GRID, changed.reshape(*GRID.shape, 3))
    whole, without = exactly(built, [LIBRARY["blue-plastic"], other])
    # few cells are touched only by pixels outside the fit
    assert float((without - whole).abs().mean()) < 0.01 * float(whole.mean())


def test_restored_frames_are_bit_identical(on_ground):
    scene = on_ground.scene
    arrays = on_ground.arrays()
    again = Transport.restored(scene, GRID, arrays)
    assert (again.rank, again.resolution) == (on_ground.rank, on_ground.resolution)
    assert again.bytes == on_ground.bytes
    np.testing.assert_array_equal(again.cells, on_ground.cells)
    mirror = torch.tensor([0.1, 0.2, 0.3])
    for table in TABLES:
        shown, restored = (
            [known.shade(part, seen(known, table), mirror) for part in range(2)]
            for known in (on_ground, again)
        )
        assert torch.equal(again.compose(restored), on_ground.compose(shown))
        assert again.frame_error(restored) == on_ground.frame_error(shown)
    for name, value in again.arrays().items():
        np.testing.assert_array_equal(value, arrays[name])


def test_odd_arrays_are_refused(built, on_ground):
    def refused(change, known=built, scene=None):
        arrays = {name: value.copy() for name, value in known.arrays().items()}
        change(arrays)
        with pytest.raises(ValueError, match="arrays"):
            Transport.restored(scene or known.scene, GRID, arrays)

    for name in built.arrays():
        refused(lambda arrays, name=name: arrays.pop(name))
        refused(lambda arrays, name=name: arrays.update({name: np.zeros((2, 2), complex)}))
        refused(lambda arrays, name=name: arrays.update({name: np.array("text")}))
        if built.arrays()[name].ndim:
            refused(lambda arrays, name=name: arrays.update({name: arrays[name][:-1]}))
    refused(lambda arrays: arrays["cells_0"].__setitem__(-1, GRID.size))
    refused(lambda arrays: arrays["probes_0"].__setitem__(0, -1))
    refused(lambda arrays: arrays["pixels_0"].__setitem__(0, arrays["pixels_0"][0] + 1))
    refused(lambda arrays: None, scene=ball(32))
    refused(lambda arrays: None, known=on_ground, scene=built.scene)


# -- fixed parts ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fixed(on_ground, training):
    ground = flat(LIBRARY["concrete"])
    return Transport(on_ground.scene, GRID, replace(training, fixed={1: ground}), rank=24)


def test_a_fixed_part_is_shown_in_its_material(fixed, on_ground):
    assert (fixed.fixed, on_ground.fixed) == ({1}, frozenset())
    assert fixed.bases[1].rank <= 9 < on_ground.bases[1].rank
    table = LIBRARY["concrete"]
    (exact,) = exactly(fixed, [table], part=1)
    frame = shade(fixed, table, part=1)
    assert relative(frame, exact) < 0.01
    assert frame.error < 0.01


def test_another_material_on_a_fixed_part_is_noticed(fixed):
    for name in ("chrome", "blue-plastic", "gold-satin"):
        assert shade(fixed, LIBRARY[name], part=1).error > 0.03, name


def test_a_freed_transport_is_that_without_fixed_parts(fixed, on_ground, training):
    before = fixed.arrays()
    told = []
    free = fixed.freed(training, progress=lambda stage, fraction: told.append(fraction))
    assert told
    expected = on_ground.arrays()
    for name, value in free.arrays().items():
        if name.endswith("_0"):  # of the shape, whose rays are the same
            np.testing.assert_array_equal(value, before[name], err_msg=name)
        else:
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
    assert free.bases[0].basis is fixed.bases[0].basis
    for name, value in fixed.arrays().items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


def test_a_restored_transport_can_be_freed(fixed, on_ground, training):
    again = Transport.restored(fixed.scene, GRID, fixed.arrays())
    assert again.fixed == {1}
    free = again.freed(training)
    for name, value in free.arrays().items():
        if name.endswith("_1"):
            np.testing.assert_array_equal(value, on_ground.arrays()[name], err_msg=name)


def test_odd_fixed_tables_are_refused(fixed, training):
    table = flat(LIBRARY["concrete"])
    for odd in ({2: table}, {-1: table}, {1: table[:, :2]}, {1: table[:-1]}):
        with pytest.raises(ValueError, match="fixed"):
            Transport(fixed.scene, GRID, replace(training, fixed=odd), rank=8)


# -- training ---------------------------------------------------------------------------------


def test_training_takes_a_table_in(built, outsiders):
    """The basis then shows a table from outside its span, and all others as well as before."""
    exact = exactly(built, [*outsiders, *TABLES])
    before = [relative(shade(built, t), e) for t, e in zip(TABLES, exact[3:], strict=True)]
    for k, table in enumerate(outsiders):
        learned = copied(built)
        assert relative(shade(learned, table), exact[k]) > 0.01
        taught = learned.shade_exactly(0, flat(table))
        learned.train(0, taught.radiance)
        frame = shade(learned, table)
        print(f"{table.name}: {relative(frame, exact[k]):.4f}, measured {frame.error:.4f}, "
              f"taught {taught.error:.4f}")  # fmt: skip
        # noise from cell to cell is shown no better by exact frames
        limit = max(0.01, 1.3 * taught.error)
        assert relative(frame, exact[k]) < limit, table.name
        assert frame.error < limit, table.name
        assert frame.error < 0.6 * shade(built, table).error, table.name
        for i, other in enumerate(TABLES):
            after = relative(shade(learned, other), exact[3 + i])
            assert after < 1.25 * before[i] + 0.005, (table.name, other.name)
    chrome = shade(built, LIBRARY["chrome"])
    assert relative(chrome, exact[3]) == before[0], "the copies were trained, not the original"


def test_training_touches_no_other_part(on_ground, outsiders):
    learned = copied(on_ground)
    taught = learned.shade_exactly(1, flat(outsiders[0]))
    image = taught.radiance
    learned.train(1, image)
    chrome = LIBRARY["chrome"]
    untouched, same = shade(learned, chrome, 0).radiance, shade(on_ground, chrome, 0).radiance
    torch.testing.assert_close(untouched, same, rtol=1e-5, atol=1e-6)
    # noise from cell to cell is shown no better by exact frames
    before, after = (shade(t, outsiders[0], 1).error for t in (on_ground, learned))
    assert after < max(0.5 * before, 1.1 * taught.error) < before
    again = Transport.restored(learned.scene, GRID, learned.arrays())
    shown, restored = (shade(t, outsiders[0], 1).radiance for t in (learned, again))
    assert torch.equal(shown, restored)
    with pytest.raises(ValueError, match="radiance"):
        learned.train(1, image[:-1])


# -- drafts -----------------------------------------------------------------------------------


def test_a_draft_is_as_good_as_it_says(training):
    scene = ball(96, rows=64)
    draft = Draft(scene, GRID, size=48)
    small = draft.scene
    assert (small.height, small.width) == (48, 48)
    index = np.sort(np.random.default_rng(0).choice(len(small.pixels), 80, replace=False))
    true, _ = reference.fragments(small, index, TABLES, 1e-3)
    stated, errors = [], []
    for i, table in enumerate(TABLES):
        image, error = draft.render([flat(table)] * 2)
        assert image.shape == (48, 48, 3)
        assert image.dtype == np.float32
        assert np.isfinite(image).all()
        assert image.min() >= 0.0
        # fragments that fill their pixels
        whole = small.weights[index] == 1.0
        shown = image.reshape(-1, 3)[small.pixels[index[whole]]]
        errors.append(reference.relative_error(shown, true[whole, i]))
        stated.append(error)
    print(f"draft: errors {np.round(errors, 4)}, stated {np.round(stated, 4)}")
    assert max(errors) < 0.05
    assert np.all(np.asarray(stated) > np.asarray(errors) / 4.0)
    assert np.mean(stated) < 4.0 * np.mean(errors)


def test_a_draft_is_small_and_shows_the_backdrop():
    scene = ball((40, 60)).changed(camera=Camera.orbit(20.0, 25.0, zoom=0.5))
    draft = Draft(scene, GRID, size=30)
    image, _ = draft.render([flat(LIBRARY["red-rubber"])] * 2)
    assert image.shape == (20, 30, 3)
    free = draft.scene.uncovered.reshape(20, 30) == 1.0
    assert free.any()
    np.testing.assert_array_equal(image[free], draft.scene.backdrop()[free])
    assert Draft(scene, GRID, size=500).scene.width == 60


def test_mirrors_in_a_draft():
    draft = Draft(ball(24), GRID)
    black = np.zeros((GRID.size, 3), np.float32)
    image, error = draft.render([black, black], [np.array([1.0, 0.5, 0.25]), np.zeros(3)])
    without, _ = draft.render([black, black])
    shown = draft.operator.mirror(np.arange(len(draft.scene.pixels)))
    expected = without.reshape(-1, 3).copy()
    own = draft.scene.part_slice(0)
    np.add.at(expected, draft.scene.pixels[own], shown[own] * np.array([1.0, 0.5, 0.25]))
    np.testing.assert_allclose(image.reshape(-1, 3), expected, rtol=1e-5, atol=1e-7)
    assert error == 0.0


@pytest.mark.parametrize("rows", [4, 8, 64])
def test_a_draft_with_a_light_tree_at_hand(rows):
    image = np.random.default_rng(1).uniform(0.1, 2.0, (rows, 2 * rows, 3))
    scene = ball(16).changed(environment=EnvironmentMap(image))
    tables = [flat(LIBRARY["red-rubber"])] * 2
    expected, _ = Draft(scene, GRID).render(tables)
    shown, _ = Draft(scene, GRID, tree=LightTree.build(scene.environment)).render(tables)
    np.testing.assert_allclose(shown, expected, rtol=1e-4)


# -- corners ----------------------------------------------------------------------------------


def test_no_light_is_black(training):
    scene = ball(16).changed(environment=EnvironmentMap(np.zeros((4, 8, 3))))
    black = Transport(scene, GRID, training, rank=8)
    shown = frames(black, LIBRARY["chrome"])
    assert all(float(f.radiance.abs().max()) == 0.0 for f in shown)
    assert all(f.error == 0.0 for f in shown)
    assert float(black.compose(shown).abs().max()) == 0.0
    assert math.isfinite(black.frame_error(shown))


def test_light_of_one_colour(training):
    red = EnvironmentMap(EnvironmentMap.sky(rows=16).image * np.array([1.0, 0.0, 0.0], np.float32))
    built = Transport(ball(20).changed(environment=red), GRID, training, rank=12)
    assert not built.grey
    for frame in frames(built, LIBRARY["blue-plastic"]):
        assert torch.isfinite(frame.radiance).all()
        assert float(frame.radiance[:, 1:].abs().max()) == 0.0
        assert float(frame.radiance[:, 0].max()) > 0.0
        assert frame.error < 0.05


def test_a_uniform_map_has_few_dimensions(training):
    """All pixels at one view angle look the same, so the basis has few images."""
    scene = Scene(sphere(), EnvironmentMap.uniform(rows=32), size=24)
    built = Transport(scene, GRID, training, rank=64)
    for table, exact in zip(TABLES, exactly(built, TABLES), strict=True):
        frame = shade(built, table)
        assert torch.isfinite(frame.radiance).all()
        assert relative(frame, exact) < 0.02
    white = shade(built, TabulatedBRDF.from_model(Lambert(1.0), GRID))
    expected = torch.from_numpy(scene.weights[:, None].astype(np.float32)).expand(-1, 3)
    torch.testing.assert_close(white.radiance, expected, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_few_pixels(size, training):
    scene = ball(size, rows=16)
    built = Transport(scene, GRID, training, rank=24)
    for part in range(2):
        count = np.count_nonzero(scene.pixel_part == part)
        for table, exact in zip(TABLES, exactly(built, TABLES, part), strict=True):
            frame = shade(built, table, part)
            assert frame.radiance.shape == (count, 3)
            assert torch.isfinite(frame.radiance).all()
            assert math.isfinite(frame.error)
            if 0 < count < 4:  # a part of few fragments
                assert relative(frame, exact) < 5e-3
    image = built.compose(frames(built, LIBRARY["chrome"]))
    assert image.shape == (size, size, 3)


def test_parts_of_a_few_pixels_and_of_none(training):
    camera = Camera.orbit(0.0, 90.0)  # from above, where the bottom is not visible
    scene = Scene(teapot(), EnvironmentMap.sky(rows=32), camera=camera, size=12)
    counts = [len(scene.pixels[scene.part_slice(i)]) for i in range(len(scene.parts))]
    assert min(counts) == 0
    assert any(1 <= n <= 40 for n in counts)
    built = Transport(scene, GRID, training, rank=24)
    table = LIBRARY["red-rubber"]
    shown = frames(built, table)
    exact = [built.shade_exactly(i, flat(table)) for i in range(len(scene.parts))]
    for count, frame, true in zip(counts, shown, exact, strict=True):
        assert frame.radiance.shape == true.radiance.shape == (count, 3)
        assert torch.isfinite(frame.radiance).all()
        if count == 0:
            part = counts.index(0)
            assert built.shade_exactly(part, flat(table), torch.ones(3)).error == 0.0
            assert frame.error == true.error == frame.level == true.level == 0.0
            assert built.radiance(part, seen(built, table)).shape == (0, 3)
            built.train(part, torch.zeros((0, 3)))
        elif count > 40:
            assert relative(frame, true.radiance) < 0.05
    assert torch.isfinite(built.compose(shown)).all()


def test_an_empty_scene(training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=8),
                  camera=Camera(target=(50.0, 0.0, 0.0), zoom=20.0), size=8)  # fmt: skip
    built = Transport(scene, GRID, training, rank=8)
    assert len(built.cells) == 0
    frame = built.shade(0, torch.zeros((0, 3)))
    np.testing.assert_array_equal(built.compose([frame]).numpy(), scene.backdrop())
    assert built.frame_error([frame]) == 0.0
    again = Transport.restored(scene, GRID, built.arrays())
    np.testing.assert_array_equal(again.compose([frame]).numpy(), scene.backdrop())


# -- building ---------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [lambda: ball(24), lambda: Scene(sphere(), size=24)])
def test_two_builds_are_bit_identical(make, training):
    first, second = (Transport(make(), GRID, training, rank=24).arrays() for _ in range(2))
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(second[name], value, err_msg=name)


def test_the_seed_decides(training):
    scene = Scene(sphere(), EnvironmentMap.sky(rows=32), size=20)
    first, second = (Transport(scene, GRID, training, rank=8, seed=s) for s in (0, 1))
    assert not np.array_equal(first.arrays()["probes_0"], second.arrays()["probes_0"])


def test_progress_is_told(training):
    told = []
    Transport(ball(20), GRID, training, rank=8, progress=lambda *news: told.append(news))
    assert all(isinstance(stage, str) and 0.0 <= part <= 1.0 for stage, part in told)
    assert told[-1][1] == pytest.approx(1.0)
    assert len({stage for stage, _ in told}) >= 2


@pytest.mark.parametrize("moment", [0.0, 0.5, 1.0])
def test_progress_can_cancel(moment, training):
    """At any time: the exception is raised, and no thread goes on computing."""

    class CancelError(Exception):
        pass

    told = []
    Transport(ball(24), GRID, training, rank=8, progress=lambda *news: told.append(news))
    last = round(moment * (len(told) - 1))
    calls = []

    def cancel(stage, fraction):
        calls.append(stage)
        if len(calls) > last:
            raise CancelError

    before = set(threading.enumerate())
    with pytest.raises(CancelError):
        Transport(ball(24), GRID, training, rank=8, progress=cancel)
    assert len(calls) == last + 1
    assert set(threading.enumerate()) <= before


def test_cancelling_takes_effect_soon(training):
    """Cancelling also stops the thread that casts the rays of the next part."""

    class CancelError(Exception):
        pass

    def cancel(stage, fraction):
        raise CancelError

    scene = Scene(teapot(), camera=Camera.orbit(-55.0, 30.0), size=64, ground=True)
    start = time.perf_counter()
    Transport(scene, GRID, training, rank=24)
    whole = time.perf_counter() - start
    start = time.perf_counter()
    with pytest.raises(CancelError):
        Transport(scene, GRID, training, rank=24, progress=cancel)
    assert time.perf_counter() - start < 0.5 * whole


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


def test_bad_tables(small_sphere, training, built):
    with pytest.raises(ValueError, match="training"):
        Transport(small_sphere, GRID, Training(training.tables[:-1], training.weight))
    with pytest.raises(ValueError, match="training"):
        Transport(small_sphere, GRID, Training(training.tables, training.weight[:-1]))
    for wrong in (torch.zeros((7, 3)), torch.zeros((len(built.cells), 2))):
        with pytest.raises(ValueError, match="table"):
            built.shade(0, wrong)
        with pytest.raises(ValueError, match="table"):
            built.radiance(0, wrong)
    with pytest.raises(ValueError, match="table"):
        built.shade_exactly(0, np.zeros((7, 3), np.float32))


def test_a_pixel_far_above_the_subset_does_not_fill_the_basis():
    # as at grazing views, or where one pixel of thousands mirrors the sun
    generator = torch.Generator().manual_seed(4)
    images = torch.randn(2000, 3, 16, generator=generator)
    images[1234] *= 1e5
    damping = damping_of(images)
    usual = torch.arange(2000) != 1234
    assert damping[1234] < 2e-4
    assert (damping[usual] == 1.0).all()
    basis = leading(images * damping[:, None, None], 48, 1e-6)
    torch.testing.assert_close(basis.T @ basis, torch.eye(48), rtol=0.0, atol=1e-4)
    assert (basis[1234] ** 2).sum() < 0.9
