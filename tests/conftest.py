"""What several test files share: real data, a writer of tensor files, small scenes to shade."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

if "PYTEST_XDIST_WORKER" in os.environ:
    # processes that share the cores would wait for each other's threads
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")

import numpy as np
import pytest
from hypothesis import settings
from sessions import over

from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.editing import EditSession
from traitbrdf.space.library import default_embedding, default_library
from traitbrdf.transport.basis import Training, training_tables
from traitbrdf.transport.transport import Transport

settings.register_profile("laws", deadline=None)  # how long a law takes is no law
settings.load_profile("laws")

_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8")


def find_shared_data() -> Path:
    """The folder of real data, ``../shared/data`` of the repository or TRAITBRDF_SHARED.

    Without it a test is skipped, save where CI=true: there a missing folder is a failure, or the
    checks against real data could vanish unseen.
    """
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TRAITBRDF_SHARED", default))
    if not folder.is_dir():
        reason = f"needs the real data at {folder} (set TRAITBRDF_SHARED to where they are)"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return folder


@pytest.fixture(scope="session", autouse=True)
def no_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests neither read nor fill the user's cache; programs that they start inherit this."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRAITBRDF_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("TRAITBRDF_CACHE_BYTES", "0")
        yield


@pytest.fixture
def shared_data() -> Path:
    return find_shared_data()


def write_tensor(path: Path, fields: Mapping[str, Any]) -> Path:
    """Write a tensor file (.bsdf): header and table first, then the arrays, 8-byte aligned."""
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    offset = 18 + sum(13 + len(name) + 8 * a.ndim for name, a in arrays.items())
    table, body = b"", b""
    for name, array in arrays.items():
        body += bytes(-(offset + len(body)) % 8)
        table += struct.pack("<H", len(name)) + name.encode()
        kind = _TYPES.index(array.dtype.str[1:]) + 1
        table += struct.pack("<HBQ", array.ndim, kind, offset + len(body))
        table += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += array.tobytes()
    path.write_bytes(b"tensor_file\0\1\0" + struct.pack("<I", len(arrays)) + table + body)
    return path


@pytest.fixture
def tensor_writer() -> Callable[[Path, Mapping[str, Any]], Path]:
    return write_tensor


@pytest.fixture
def rgl_fields() -> dict[str, Any]:
    """The fields of a small RGL material: a Lambert surface of albedo (0.8, 0.4, 0.1).

    The warp is the identity, so the stored f cos(theta_o) is tabulated over
    u = sqrt(2 theta_m / pi) and the azimuth of the half vector directly.
    """
    n = 96
    theta_i = np.radians(np.linspace(0.0, 90.0, 46))
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    theta_m, phi_m = u * u * math.pi / 2, (2 * v - 1) * math.pi
    ti = theta_i[:, None, None]
    dot = np.sin(ti) * np.sin(theta_m) * np.cos(phi_m) + np.cos(ti) * np.cos(theta_m)
    cos_o = 2 * dot * np.cos(theta_m) - np.cos(ti)
    albedo = np.array([0.8, 0.4, 0.1])[:, None, None]
    luminance = (cos_o / math.pi)[None].astype(np.float32)
    return {
        "description": np.frombuffer(b"a test material", np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": theta_i.astype(np.float32),
        "sigma": np.ones((2, 4), np.float32),
        "ndf": np.ones((2, 4), np.float32),
        "vndf": np.ones((1, len(theta_i), 8, 8), np.float32),
        "luminance": luminance,
        "rgb": (luminance[:, :, None] * albedo).astype(np.float32),
        "jacobian": np.zeros(1, np.uint8),
        "version": np.array([1, 0], np.uint32),
    }


@pytest.fixture(scope="session")
def small_sphere() -> Scene:
    """A sphere under a coarse sky: some 1,000 pixels."""
    return Scene(sphere(), EnvironmentMap.sky(rows=32), camera=Camera.orbit(20.0, 10.0), size=36)


@pytest.fixture(scope="session")
def small_teapot() -> Scene:
    """A teapot under a coarse, turned sky and two lights beside it, in an oblong frame."""
    lights = [
        PointLight(position=(3.0, 4.0, 3.0), intensity=(20.0, 18.0, 15.0)),
        DirectionalLight(direction=(-1.0, 2.0, 0.7), irradiance=(0.3, 0.4, 0.6)),
    ]
    sky = EnvironmentMap.sky(rows=32).rotated(0.7)
    return Scene(teapot(), sky, lights, Camera.orbit(35.0, 20.0), size=(48, 60))


@pytest.fixture(scope="session")
def training() -> Training:
    """Every sixth of the tables that a session trains its bases with."""
    embedding, library = default_embedding(), default_library()
    channels = [embedding.decode_values(z) for z in library.coordinates[::6]]
    whole = training_tables(np.concatenate(channels, axis=1), embedding.grid_)
    return Training(np.ascontiguousarray(whole.tables[:, ::3]), whole.weight[::3])


@pytest.fixture
def small_training(training: Training, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions fit their bases to few materials."""
    monkeypatch.setattr("traitbrdf.session.preparation.training_of", lambda library, seed: training)


@pytest.fixture
def types_take_as_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which number type is faster is measured: on a busy machine it comes out either way."""
    monkeypatch.setattr("traitbrdf.session.budget.median_seconds", lambda *_: 1e-3)


@pytest.fixture(scope="session")
def prepared(small_teapot: Scene, training: Training) -> Transport:
    """A teapot in few pixels, prepared for edits of all parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("traitbrdf.session.preparation.training_of", lambda library, seed: training)
        return EditSession(small_teapot, quality="preview", cache=False).prepare()


@pytest.fixture
def fresh(prepared: Transport) -> Callable[..., EditSession]:
    """Makes new sessions over one prepared scene; they do without exact frames unless asked."""
    return lambda **arguments: over(prepared, **{"error": 1.0, **arguments})


@pytest.fixture
def edit(fresh: Callable[..., EditSession]) -> EditSession:
    return fresh()
