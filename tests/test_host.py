"""Good manners in a host program: its settings stay, its threads and forks work or are told why."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import traitbrdf as tb
from traitbrdf.formats.files import atomic_path
from traitbrdf.host import steady
from traitbrdf.session.cache import Cache

WORK = """
import sys
import numpy as np, torch
import traitbrdf as tb

def work():
    scene = tb.Scene(tb.teapot(8), tb.EnvironmentMap.sky(rows=16), size=24, ground=True)
    edit = tb.EditSession(scene, cache=False)
    edit.assign("body", "red-rubber")
    edit.move("body", shiny=0.5)
    edit.paint(tb.Stroke([(10, 12), (14, 13)], radius=4), tb.Assign("gold-polished"), where="local")
    edit.report()
    ball = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=8), size=4)
    exact = tb.reference.render(ball, {"sphere": tb.default_library()["red-rubber"]})
    return np.concatenate([edit.render().ravel(), exact.ravel().astype(np.float32)])
"""
SETTINGS = {
    "float64": "torch.set_default_dtype(torch.float64)",
    "another device": "torch.set_default_device('meta')",
    "numpy raises": "np.seterr(all='raise')",
    "inference mode": "torch.inference_mode().__enter__()",
}


def run(code: str, **options) -> subprocess.CompletedProcess:
    package = str(Path(tb.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": package, **options.pop("env", {})}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False,
        timeout=300, env=environment, **options,
    )  # fmt: skip


@pytest.mark.slow
def test_settings_of_the_host_change_no_frame_and_stay(tmp_path):
    ends = {"": "", **SETTINGS}
    frames = {}
    for name, setting in ends.items():
        path = tmp_path / f"{len(frames)}.npy"
        after = (
            "assert np.geterr() == before[0] and torch.get_default_dtype() == before[1]\n"
            "assert torch.get_default_device() == before[2]\n"
            "assert torch.is_inference_mode_enabled() == before[3]\n"
        )
        now = (
            "before = (np.geterr(), torch.get_default_dtype(), torch.get_default_device(),\n"
            "          torch.is_inference_mode_enabled())\n"
        )
        done = run(
            f"{WORK}\n{setting}\n{now}found = work()\n{after}np.save({str(path)!r}, found)\n"
        )
        assert done.returncode == 0, f"{name}: {done.stderr[-2000:]}"
        frames[name] = np.load(path)
        np.testing.assert_allclose(frames[name], frames[""], rtol=1e-5, atol=1e-7, err_msg=name)


def test_steady_keeps_what_a_function_is():
    @steady
    def halve(x: float) -> float:
        """Halve."""
        return float(np.float32(x) * np.float32(1e-45))

    assert halve.__doc__ == "Halve."
    with np.errstate(all="raise"):
        assert halve(0.1) == 0.0
        with pytest.raises(FloatingPointError):
            np.float32(0.1) * np.float32(1e-45)


# -- processes ------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_a_fork_after_a_frame_says_what_to_do(fresh_frame):
    """It waited for threads that a fork does not copy."""
    edit = fresh_frame
    code = (
        f"{WORK}\nimport multiprocessing\nwork()\n"
        "def child(queue):\n"
        "    try:\n        work(); queue.put('fine')\n"
        "    except RuntimeError as error:\n        queue.put(str(error))\n"
        "context = multiprocessing.get_context('fork')\nqueue = context.SimpleQueue()\n"
        "process = context.Process(target=child, args=(queue,))\nprocess.start()\n"
        "print(queue.get())\nprocess.join()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "PYTHONPATH": str(Path(tb.__file__).parents[1])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert "multiprocessing.get_context('spawn')" in done.stdout
    assert edit.render().shape == (24, 24, 3)  # and this one goes on


@pytest.fixture(scope="module")
def fresh_frame() -> tb.EditSession:
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=24)
    edit = tb.EditSession(scene, cache=False)
    edit.assign("sphere", "red-rubber")
    edit.render()
    return edit


@pytest.mark.parametrize("how", [pickle.dumps, copy.copy, copy.deepcopy])
def test_sessions_cannot_be_pickled_but_saved(fresh_frame, how):
    with pytest.raises(TypeError, match=r"session\.save\('design\.tbr'\) and EditSession\.load"):
        how(fresh_frame)


@pytest.mark.parametrize("what", ["scene", "table", "map", "model"])
def test_values_can_be_pickled(fresh_frame, what):
    value = {
        "scene": fresh_frame.scene, "table": fresh_frame.brdf("sphere"),
        "map": tb.EnvironmentMap.sky(rows=4), "model": tb.models.GGX(alpha=0.2),
    }[what]  # fmt: skip
    again = pickle.loads(pickle.dumps(value))  # noqa: S301
    assert type(again) is type(value)


def ordinary() -> list[str]:
    """The beginning of a command that has no more rights than those of files and folders."""
    if os.getuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("needs setpriv to run without root's rights")
    return ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "setuid"), reason="needs rights as Unix has them")
def test_a_read_only_installation_without_a_home(tmp_path):
    package = tmp_path / "site" / "traitbrdf"
    shutil.copytree(Path(tb.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    for path in [tmp_path, *tmp_path.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    code = (
        "import traitbrdf as tb, numpy as np\n"
        "from traitbrdf.compiled import CACHED\n"
        "space, library = tb.default_traits(), tb.default_library()\n"
        "z = library.coordinates[library.index('red-rubber')]\n"
        "assert space.score(z)\n"
        "print(CACHED, tb.__file__)\n"
    )
    try:
        done = subprocess.run(
            [*ordinary(), sys.executable, "-B", "-c", code], capture_output=True, text=True,
            check=False, timeout=300, cwd="/",
            env={"PYTHONPATH": str(tmp_path / "site"), "HOME": "/proc/none", "PATH": "/usr/bin"},
        )  # fmt: skip
    finally:
        for path in [tmp_path, *tmp_path.rglob("*")]:
            path.chmod(0o755 if path.is_dir() else 0o644)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == ["False", str(package / "__init__.py")]


# -- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("said", ["", "~/kept", "/kept"])
def test_the_cache_folder(monkeypatch, tmp_path, said):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("TRAITBRDF_CACHE", said)
    monkeypatch.setenv("TRAITBRDF_CACHE_BYTES", "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    cache = Cache.usual()
    assert cache is not None
    expected = {"~/kept": tmp_path / "kept", "/kept": Path("/kept")}
    assert cache.folder == expected.get(said, cache.folder)
    assert "~" not in str(cache.folder)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
def test_a_pipe_gets_the_bytes_and_stays_a_pipe(tmp_path):
    pipe, got = tmp_path / "pipe.png", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    with atomic_path(pipe) as temporary:
        temporary.write_bytes(b"all of it")
    reader.join()
    assert got == [b"all of it"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_device_stays_a_device():
    with atomic_path(os.devnull) as temporary:
        temporary.write_bytes(b"gone")
    assert stat.S_ISCHR(Path(os.devnull).stat().st_mode)


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755])
def test_rights_survive(tmp_path, mode):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    path.chmod(mode)
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"new")
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_bytes() == b"new"


def test_new_files_have_the_usual_rights(tmp_path):
    with atomic_path(tmp_path / "a.bin") as temporary:
        temporary.write_bytes(b"new")
    (tmp_path / "b.bin").write_bytes(b"new")
    assert (tmp_path / "a.bin").stat().st_mode == (tmp_path / "b.bin").stat().st_mode


@pytest.mark.skipif(not hasattr(os, "setuid"), reason="needs rights as Unix has them")
@pytest.mark.parametrize("what", ["file", "folder"])
def test_what_may_not_be_written_is_named(tmp_path, what):
    path = tmp_path / "kept" / "a.exr"
    path.parent.mkdir()
    path.write_bytes(b"old")
    (path if what == "file" else path.parent).chmod(0o444 if what == "file" else 0o555)
    code = (
        "import numpy as np\nfrom traitbrdf.formats.images import write_exr\n"
        f"try:\n    write_exr({str(path if what == 'file' else path.with_name('b.exr'))!r},"
        " np.ones((2, 2, 3)))\n"
        "except PermissionError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [*ordinary(), sys.executable, "-B", "-c", code], capture_output=True, text=True,
        check=False, timeout=120, cwd="/",
        env={"PYTHONPATH": str(Path(tb.__file__).parents[1]), "HOME": "/proc/none"},
    )  # fmt: skip
    path.parent.chmod(0o755)
    name = "a.exr" if what == "file" else "b.exr"
    assert done.stdout.strip() == f"{path.with_name(name)}: not allowed to write there", done.stderr
    assert path.read_bytes() == b"old"


def test_spawned_processes_work():
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        assert pool.apply(len, (tb.default_library().names,)) == len(tb.default_library())
