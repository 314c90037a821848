"""What is made at the installation, so that no session waits for it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import traitbrdf as tb
from traitbrdf.compiled import drop_outdated
from traitbrdf.session import preparation, warmup
from traitbrdf.session.cache import Cache
from traitbrdf.session.editing import EditSession
from traitbrdf.space.traits import TraitSpace

_SESSION = """
import time
import traitbrdf as tb
lights = [tb.PointLight((3, 4, 3), (20, 18, 15)), tb.DirectionalLight((-1, 2, 0.7), (1, 1, 1))]
for some in ([], lights):
    scene = tb.Scene(tb.teapot(), tb.EnvironmentMap.sky(rows=32), some, size=24, ground=True)
    edit = tb.EditSession(scene, "preview")
    edit.draft()
    edit.prepare(wait=False)
    while not edit.ready:
        edit.draft()
        time.sleep(0.05)
    edit.move("lid", shiny=0.5)
    edit.paint(tb.Stroke([(10, 12), (14, 12)], trait="metallic", amount=0.5, radius=3))
    edit.render()
    edit.assign(scene.parts, "gold-polished")
    edit.render()
    edit.look(rotation=1.0)
    edit.render()
    edit.report()
"""


@pytest.mark.slow
def test_after_compile_a_session_compiles_nothing(tmp_path: Path) -> None:
    code, cache = tmp_path / "code", tmp_path / "cache"
    environment = {
        **os.environ, "NUMBA_CACHE_DIR": str(code), "TRAITBRDF_CACHE": str(cache),
        "TRAITBRDF_CACHE_BYTES": str(10**9),
    }  # fmt: skip

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        call = [sys.executable, *arguments]
        done = subprocess.run(call, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done

    def files() -> dict[str, int]:
        return {str(p): p.stat().st_mtime_ns for p in code.rglob("*") if p.is_file()}

    first = run("-m", "traitbrdf.cli", "compile")
    assert first.stdout.startswith("compiled")
    assert "\r" not in first.stderr
    stages = [line.split(":")[0] for line in first.stderr.splitlines()]
    assert list(dict.fromkeys(stages)) == ["loading", "compiling", "universal basis"]
    compiled = files()
    assert compiled
    assert len(list(cache.iterdir())) == 1  # the universal basis
    again = run("-m", "traitbrdf.cli", "compile")
    assert again.stdout.startswith("all is compiled")
    run("-c", _SESSION)
    assert files() == compiled


def test_a_failure_beside_is_made_up_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second process only saves time."""
    monkeypatch.setattr(sys, "executable", "")
    with warmup._moves_beside():
        pass
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with warmup._moves_beside():
        pass
    monkeypatch.setattr(sys, "executable", "/bin/sleep")  # knows none of the arguments
    with pytest.raises(KeyboardInterrupt), warmup._moves_beside():
        raise KeyboardInterrupt


@pytest.mark.usefixtures("small_training")
def test_moves_are_compiled_behind_the_first_images(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Compiling them may take as long as it likes, and the scene is shown and prepared."""
    go, asked, order = threading.Event(), threading.Event(), []

    def slow(library: tb.Library, traits: TraitSpace) -> None:
        order.append("moves")
        asked.set()
        assert go.wait(60.0)

    def told(stage: str, fraction: float) -> None:
        order.append(stage)

    monkeypatch.setattr(preparation, "compile_moves", slow)
    monkeypatch.setattr("traitbrdf.transport.universal.VIEWS", 2)
    scene = tb.Scene(tb.sphere(), tb.EnvironmentMap.sky(rows=16), size=12)
    session = EditSession(scene, "preview", progress=told, cache=False)
    session._cache = Cache(tmp_path, 10**9)
    try:
        session.prepare(wait=False)
        job = session.view.job
        assert job is None or job.done.wait(120.0)
        assert session.render().shape == (12, 12, 3)
        assert asked.wait(10.0)
        assert order[0] == "compiling"
        assert order.index("nodes") < order.index("moves") < order.index("far images")
    finally:
        go.set()
    for thread in behind():
        thread.join(60.0)


def behind() -> list[threading.Thread]:
    """The threads that work behind the first images."""
    names = ("traitbrdf-compile", "traitbrdf-cache")
    return [thread for thread in threading.enumerate() if thread.name in names]


def test_what_is_started_in_the_background_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A program that ends would cut off the daemons of a daemon, even within compiled code."""
    go = threading.Event()
    monkeypatch.setattr(preparation, "compile_moves", lambda *_: go.wait(60.0))
    monkeypatch.setattr(Cache, "write", lambda *_: go.wait(60.0))
    palette = tb.effects.Palette(tb.default_library(), tb.default_traits())

    def start() -> None:
        Cache(tmp_path, 1).write_behind("key", {})
        preparation._compile_behind(palette)

    daemon = threading.Thread(target=start, daemon=True)
    daemon.start()
    daemon.join(60.0)
    found = behind()
    go.set()
    assert [thread.daemon for thread in found] == [False, False]
    for thread in found:
        thread.join(60.0)


def test_compiled_code_that_is_older_than_its_source_is_removed(tmp_path: Path) -> None:
    """A function of another file may be part of it, and a class that it names may have moved."""
    times = {
        "reflectance/a.py": 10, "reflectance/__pycache__/a.f-1.py311.nbi": 11,
        "space/b.py": 5, "space/c.py": 12, "space/__pycache__/b.g-1.py311.nbi": 11,
        "transport/d.py": 1, "transport/__pycache__/d.h-1.py311.nbi": 11,
        "transport/__pycache__/d.k-1.py311.nbi": 13, "transport/__pycache__/d.h-1.py311.1.nbc": 11,
    }  # fmt: skip
    for name, seconds in times.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
        os.utime(path, (seconds, seconds))
    gone = {
        tmp_path / "space/__pycache__/b.g-1.py311.nbi",
        tmp_path / "transport/__pycache__/d.h-1.py311.nbi",
    }
    assert set(drop_outdated(tmp_path)) == gone
    assert not any(path.exists() for path in gone)
    assert sum(path.is_file() for path in tmp_path.rglob("*")) == len(times) - len(gone)
    assert drop_outdated(tmp_path) == []
