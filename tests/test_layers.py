"""The layers of the package: which room may import which. Add new rooms here."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "traitbrdf"

FLOORS = (
    ("arguments", "compiled", "host"),
    ("directions", "formats"),
    ("reflectance",),
    ("scene", "recipes"),
    ("transport", "reference"),
    ("pictures",),
    ("space",),
    ("design",),
    ("export",),
    ("session",),
    ("bench", "studio", "testing"),
    ("facts",),
    ("cli",),
)
"""Rooms and single modules; each imports only from earlier floors."""

FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
LONGEST = 900
LONGER = {"reflectance/models.py"}
"""Greatest length of a file, and the exception: a list of many things of one kind."""

HOMES = {
    "OpenEXR": {"formats/exr.py", "formats/images.py"},
    "mapbox_earcut": {"formats/polygons.py"},
    "DracoPy": {"formats/gltf.py"},
    "sklearn": {"space/fitting.py", "space/definitions.py"},
    "embreex": {"scene/shapes.py"},
    "numba": {
        "reflectance/descriptors.py", "scene/trails.py", "space/highlights.py", "space/scores.py",
        "transport/interpolation.py", "transport/kernels.py",
    },
}  # fmt: skip
"""Files that may import an outside package."""


def module_of(path: Path) -> str:
    """The room, by its name in FLOORS, that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(source: str, package: str) -> set[str]:
    """Dotted names of all imports, including those under TYPE_CHECKING and in functions.

    `from a import b` counts as a.b, since b may be a module; `package` resolves relative imports.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                parents = parents[: len(parents) - node.level + 1]
                base = ".".join([*parents, base]).rstrip(".")
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def files() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def imports_of(path: Path) -> set[str]:
    package = ".".join(path.relative_to(ROOT).parent.parts)
    return imports(path.read_text(encoding="utf-8"), package)


def house_imports(path: Path) -> set[str]:
    """The modules of this package that a file imports; "" for the package's public names."""
    names = set()
    for name in imports_of(path):
        first, _, rest = name.partition(".")
        if first == "traitbrdf":
            names.add(rest.partition(".")[0])
    return names


everywhere = pytest.mark.parametrize("path", files(), ids=lambda p: str(p.relative_to(PACKAGE)))


def test_imports_are_found_in_every_form():
    source = (
        "import a.b\nfrom c import d\nfrom . import e\nfrom .f import g\nfrom ..h import i\n"
        "if TYPE_CHECKING:\n    import j\ndef k():\n    import l as m\n"
    )
    expected = {"a.b", "c.d", "top.sub.e", "top.sub.f.g", "top.h.i", "j", "l"}
    assert imports(source, "top.sub") == expected


def test_the_package_is_found():
    assert {"directions", "formats", "reflectance", "scene"} <= {module_of(p) for p in files()}


@everywhere
def test_every_module_has_its_floor(path):
    assert module_of(path) in FLOOR, f"add {module_of(path)} to FLOORS"


@everywhere
def test_imports_go_down(path):
    own = module_of(path)
    assert own in FLOOR, f"add {own} to FLOORS"
    names = house_imports(path) - {own}
    if FLOOR[own] == len(FLOORS) - 1:
        names -= {""}  # only the command line may import the public names
    for name in names:
        assert name in FLOOR, f"{own} imports traitbrdf.{name}, which is on no floor"
        assert FLOOR[name] < FLOOR[own], f"{own} imports {name} from its own or a higher floor"


def test_imports_within_a_room_make_no_circle():
    """The files of a room are layered, too."""
    known = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files()}
    below = {}
    for name, path in known.items():
        parents = {i.rpartition(".")[0] for i in imports_of(path)} | imports_of(path)
        below[name] = {other for other in parents & known.keys() if other != name}
    assert list(TopologicalSorter(below).static_order())


@everywhere
def test_the_document_is_plain_values(path):
    """It shades nothing and starts no thread."""
    if module_of(path) == "design":
        outside = {name.split(".")[0] for name in imports_of(path)}
        assert not outside & {"torch", "threading", "numba", "concurrent"}
        assert not house_imports(path) & {"transport", "reference", "pictures"}


@everywhere
def test_the_package_does_not_need_its_recipes(path):
    assert not {name for name in imports_of(path) if name.split(".")[0] == "data_gen"}


@everywhere
def test_outside_packages_stay_in_their_homes(path):
    for name in imports_of(path):
        homes, file = HOMES.get(name.split(".")[0]), str(path.relative_to(PACKAGE))
        assert homes is None or file in homes, f"{file} imports {name}"


def test_recipes_import_what_the_package_has():
    for path in sorted((ROOT / "data_gen").rglob("*.py")):
        assert house_imports(path) <= {*FLOOR, ""}, path


@everywhere
def test_measurement_is_a_leaf(path):
    if module_of(path) not in ("bench", "cli"):
        assert "bench" not in house_imports(path)


@everywhere
def test_files_can_be_read_in_one_go(path):
    if str(path.relative_to(PACKAGE)) not in LONGER:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST


@everywhere
def test_what_is_loaded_late_says_why(path):
    """The first import of this package within a function has a comment above."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef):
            late = [
                node.lineno
                for node in function.body
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("traitbrdf")
            ]
            if late:
                assert "#" in lines[late[0] - 2], f"{path}:{late[0]}"


def test_no_module_is_a_drawer():
    for path in files():
        for part in path.relative_to(PACKAGE).parts:
            for word in ("util", "helper", "common", "manager", "misc"):
                assert word not in part.lower(), path


def test_public_names_are_few_and_listed():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    listed = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets)
    ]
    assert len(listed) == 1, "__init__.py has to state __all__ once"
    names = listed[0]
    assert len(names) == len(set(names)) <= 25  # beside effects
    bound = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    } | {t.id for node in tree.body if isinstance(node, ast.Assign) for t in node.targets}
    assert set(names) <= bound


def test_materials_and_traits_do_not_wait_for_torch():
    code = (
        "import sys, traitbrdf as tb\n"
        "z = tb.default_library().coordinates[0]\n"
        "tb.default_traits().move(tb.default_embedding().clip(z), {'shiny': 0.1})\n"
        "from traitbrdf.design import document, storage\n"
        "assert not {'torch', 'sklearn'} & set(sys.modules)\n"
        "assert tb.EditSession is tb.EditSession and 'torch' in sys.modules\n"
        "from traitbrdf.studio import session\n"
        "assert callable(tb.studio)\n"
        "try:\n    tb.nothing\nexcept AttributeError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "module 'traitbrdf' has no attribute 'nothing'\n"
    names = subprocess.run([sys.executable, "-c", "from traitbrdf import *; EditSession; teapot()"])
    assert names.returncode == 0


def test_info_does_not_wait_for_torch():
    code = (
        "import sys\nfrom traitbrdf.cli import main\n"
        "assert main(['info']) == 0\nassert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True)
    assert done.returncode == 0, done.stderr


def test_the_walk_from_the_mouse_to_the_pixel_goes_down():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    section = text.split("## A stroke")[1].split("##")[0]
    walk = [PACKAGE.parent / name for name in re.findall(r"`(traitbrdf/[\w/.]+)`", section)]
    assert 5 <= len(walk) <= 8
    assert all(path.is_file() for path in walk)
    floors = [FLOOR[module_of(path)] for path in walk]
    assert floors == sorted(floors, reverse=True)
    for above, path in itertools.pairwise(walk):
        if path.suffix == ".py":
            name = ".".join(above.relative_to(ROOT).with_suffix("").parts)
            assert not any(f"{found}.".startswith(f"{name}.") for found in imports_of(path))
