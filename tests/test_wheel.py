"""The wheel: what a user installs works by itself, and brings nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

SCRIPT = """
import sys
from pathlib import Path
import numpy as np
import traitbrdf as tb
assert Path(tb.__file__).is_relative_to(sys.argv[1]), tb.__file__
scene = tb.Scene(tb.teapot(), tb.EnvironmentMap.sky(), size=24, subsamples=1, shadows=False)
edit = tb.EditSession(scene, cache=False)
edit.assign(scene.parts, "red-rubber")
edit.move("lid", shiny=0.5)
image, error = edit.draft()
assert image.shape == (24, 24, 3) and np.isfinite(image).all() and image.max() > 0.0
edit.brdf("lid").write(Path(sys.argv[1]) / "lid.binary")
assert {"canvas.js", "link.js", "page.html", "page.js"} <= {
    file.name for file in (Path(tb.__file__).parent / "studio").iterdir()
}
"""


@pytest.mark.slow
def test_the_installed_wheel_works(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", tmp_path, ROOT], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        top = {name.split("/")[0] for name in file.namelist()}
    assert {name for name in top if not name.endswith(".dist-info")} == {"traitbrdf"}
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)
    env = {**os.environ, "PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    subprocess.run([sys.executable, "-P", "-c", SCRIPT, site], check=True, cwd=tmp_path, env=env)
