"""What the first session would wait for, made ahead: compiled code and the universal basis.

All code is called as sessions call it, on a tiny scene: numba compiles what is called and keeps it
on disk, where later processes find it. What is there already is only loaded.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from traitbrdf.scene.lights import DirectionalLight, EnvironmentMap, PointLight
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.session.cache import Cache, universal_key
from traitbrdf.session.preparation import compile_moves, universal_basis
from traitbrdf.session.settings import Settings
from traitbrdf.space.library import Library, default_library
from traitbrdf.space.material import Material
from traitbrdf.space.traits import default_traits
from traitbrdf.transport.drafts import Draft
from traitbrdf.transport.glances import Glances
from traitbrdf.transport.nodes import NodeTransport
from traitbrdf.transport.operator import Operator
from traitbrdf.transport.universal import UniversalBasis
from traitbrdf.transport.visibility import Progress

_SIZE = 16  # pixels of the scene


def warm_up(progress: Progress | None = None) -> bool:
    """Compile all code that sessions run, and fit the universal basis, unless that is done.

    Without a cache of prepared scenes there is no universal basis.

    Parameters
    ----------
    progress : callable or None
        Is told of each stage and fraction; it may raise to cancel.

    Returns
    -------
    bool
        Whether there was anything to do.
    """
    report = progress or (lambda stage, fraction: None)
    library = default_library()
    # sessions have lights as well, which other code shades with
    lights = PointLight((3.0, 4.0, 3.0), (9.0, 9.0, 9.0)), DirectionalLight((0, 1, 0), (1, 1, 1))
    scene = Scene(sphere(), EnvironmentMap.sky(rows=16), lights, size=_SIZE, ground=True)
    report("compiling", 0.0)
    operator = Operator(scene, library.embedding.grid_)
    fresh = _compiled() > 0
    report("compiling", 0.05)
    with _moves_beside() if fresh else contextlib.nullcontext():
        _images(library, scene, operator, report)
    report("compiling", 0.9)
    compile_moves(library, default_traits())
    fresh |= _compiled() > 0
    report("compiling", 1.0)
    cache, seed = Cache.usual(), Settings().seed
    if cache is not None:
        fresh |= not cache.file(universal_key(library, seed)).exists()
        universal_basis(library, seed, cache, report)
    return fresh


def warm_up_moves() -> None:
    """Compile moves and what decodes materials, in this process."""
    library = default_library()
    compile_moves(library, default_traits())
    Material(library.coordinates[0], np.zeros(3)).values(library.embedding)


def _images(library: Library, scene: Scene, operator: Operator, report: Progress) -> None:
    """Render a draft, images at nodes and a glance, which is all that a preparation runs, too."""
    table = Material(library.coordinates[0], np.zeros(3)).values(library.embedding)
    tables = [table] * len(scene.parts)
    Draft(scene, operator.grid, tree=operator.tree).render(tables)
    report("compiling", 0.8)
    # no basis for frames that are looked at, but of the same types
    ones = np.ones((3, 3), np.float32)
    basis = UniversalBasis(operator.grid, table, table.T.copy(), ones[0], ones)
    nodes = NodeTransport(scene, basis, tables, _SIZE, tree=operator.tree)
    nodes.refined(2 * _SIZE, tables).frame(tables)
    Glances(operator.grid).frame(scene, tables, tree=operator.tree)


@contextlib.contextmanager
def _moves_beside() -> Iterator[None]:
    """Compile moves in a second process, since numba compiles one function at a time in each.

    If that fails, this process compiles them.
    """
    if not sys.executable:  # an interpreter within another program
        yield
        return
    code = "from traitbrdf.session.warmup import warm_up_moves; warm_up_moves()"
    paths = os.pathsep.join(path for path in sys.path if path)
    with subprocess.Popen(
        [sys.executable, "-P", "-c", code], env={**os.environ, "PYTHONPATH": paths},
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            yield
        except BaseException:
            process.kill()
            raise


def _compiled() -> int:
    """Return how many functions of this package this process compiled, instead of loading them."""
    modules = [m for name, m in sys.modules.items() if name.startswith("traitbrdf.")]
    found = {id(f): f for m in modules for f in vars(m).values() if hasattr(f, "py_func")}
    return sum(sum(f.stats.cache_misses.values()) for f in found.values())
