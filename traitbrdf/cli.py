"""The command line.

``traitbrdf demo | paint | render | angles | gallery | studio | info | convert | export | validate |
bench``.

``traitbrdf compile`` ends the installation.
The exit status is 0 on success, 1 on failure with one readable line, 2 on wrong usage.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import math
import sys
import threading
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import traitbrdf as tb
from traitbrdf.bench.records import NAMES, ON_REQUEST
from traitbrdf.design.strokes import follow
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.formats.files import unknown_name
from traitbrdf.formats.images import read_image, write_exr, write_png
from traitbrdf.reflectance.brdf import SUFFIXES, Reflectance
from traitbrdf.scene.shapes import Shape
from traitbrdf.studio import need_packages

DEMO_MATERIAL = "red-rubber"
GALLERY = ("blue-plastic", "gold-polished", "red-rubber")

DEMO_CAMERA = (-35.0, 20.0, 1.05)
DEMO_AMOUNT = 0.8


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    Parameters
    ----------
    arguments : sequence of str or None
        None is `sys.argv`.
    """
    parser = _parser()
    given = parser.parse_args(arguments)
    for stream in (sys.stdout, sys.stderr):
        # names of parts may have letters that a console cannot show
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        status: int = given.run(given)
    except KeyboardInterrupt:
        print("traitbrdf: interrupted", file=sys.stderr)
        return 1
    except (ValueError, TypeError, OSError, RuntimeError, ArithmeticError) as error:
        message = " ".join(str(error).split()) or type(error).__name__
        print(f"traitbrdf: {message}", file=sys.stderr)
        return 1
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="traitbrdf", description="Paint traits, not parameters: edit real materials."
    )
    parser.add_argument("--version", action="version", version=f"traitbrdf {tb.__version__}")
    commands = parser.add_subparsers(required=True, metavar="command")

    demo = commands.add_parser("demo", help="paint 'shiny' on the teapot's handle and see it")
    _add_scene(demo)
    demo.add_argument("--out", type=Path, default=Path("out/demo"), help="folder (%(default)s)")
    demo.set_defaults(ground=2.0)
    demo.add_argument("--material", default=DEMO_MATERIAL, help="library name (%(default)s)")
    demo.set_defaults(run=_demo)

    paint = commands.add_parser("paint", help="edit traits of one part and write a picture")
    _add_scene(paint)
    paint.add_argument("--part", help="part to edit (default: the handle, or the only part)")
    paint.add_argument(
        "--trait", action="append", required=True, metavar="NAME=AMOUNT", type=_trait,
        help="trait and amount, as in shiny=0.6; may be repeated",
    )  # fmt: skip
    _add_hold(paint)
    paint.add_argument("--material", default=DEMO_MATERIAL, help="library name (%(default)s)")
    paint.add_argument("--out", type=Path, required=True, help="picture (.png) or radiance (.exr)")
    paint.add_argument("--save", type=Path, help="also write the design (.tbr)")
    paint.set_defaults(run=_paint)

    render = commands.add_parser("render", help="render a material or a saved design")
    _add_scene(render)
    render.add_argument(
        "--material", default=DEMO_MATERIAL,
        help="library name, or a MERL .binary or RGL .bsdf file (%(default)s)",
    )  # fmt: skip
    render.add_argument("--design", type=Path, help="a design saved as .tbr; replaces the scene")
    render.add_argument(
        "--reference", action="store_true", help="use the reference integrator: slow, exact"
    )
    render.add_argument("--out", type=Path, required=True, help="picture (.png) or radiance (.exr)")
    render.set_defaults(run=_render)

    angles = commands.add_parser("angles", help="map of the BRDF angles that a scene shows")
    _add_scene(angles)
    angles.add_argument("--part", help="only this part (default: the whole shape)")
    angles.add_argument("--out", type=Path, required=True, help="picture (.png)")
    angles.set_defaults(run=_angles)

    studio = commands.add_parser("studio", help="paint live in a page served by this machine")
    _add_scene(studio)
    studio.add_argument("--mesh", type=Path, help="mesh file (.obj, .ply, .glb, ...) to paint on")
    studio.add_argument("--material", default="blue-plastic", help="library name (%(default)s)")
    studio.add_argument("--design", type=Path, help="a design saved as .tbr; replaces the scene")
    studio.add_argument("--port", type=int, default=0, help="0 takes any free port (%(default)s)")
    studio.add_argument("--no-browser", action="store_true", help="only print the address")
    studio.set_defaults(run=_studio, ground=2.0)

    gallery = commands.add_parser("gallery", help="spheres of materials, moved along traits")
    gallery.add_argument(
        "--trait", action="append", default=[], metavar="NAME",
        help="trait to move from -1 to 1; may be repeated; 'all' is every trait",
    )  # fmt: skip
    gallery.add_argument(
        "--material", action="append", default=[], metavar="NAME",
        help=f"library name; may be repeated (default: {', '.join(GALLERY)})",
    )  # fmt: skip
    _add_hold(gallery)
    gallery.add_argument(
        "--method", choices=("flow", "linear"), default="flow",
        help="linear: the linear trait vectors of Matusik et al. 2003 (%(default)s)",
    )  # fmt: skip
    gallery.add_argument(
        "--amount", action="append", type=float, metavar="AMOUNT",
        help="amounts to move by; may be repeated (default: seven from -1 to 1)",
    )  # fmt: skip
    gallery.add_argument(
        "--table", action="store_true", help="one row per trait, the materials side by side"
    )
    gallery.add_argument(
        "--brushes", action="store_true",
        help="instead: before and after of every brush, slider and effect, with its calls",
    )  # fmt: skip
    gallery.add_argument("--env", type=Path, help="HDR map (.exr, .hdr); default: a sky")
    gallery.add_argument(
        "--size", type=_size, help="pixels per sphere (default: 96; with --brushes 200)"
    )
    gallery.add_argument("--out", type=Path, required=True, help="picture (.png)")
    gallery.set_defaults(run=_gallery)

    info = commands.add_parser("info", help="list what the package ships, or what a file holds")
    info.add_argument(
        "file", nargs="?", help="a material, map, mesh or design, or a library material's name"
    )
    info.add_argument(
        "--picture", type=Path, metavar="PNG",
        help="also draw it: a material as a lit sphere, its lobes and its albedo; a map",
    )  # fmt: skip
    info.set_defaults(run=_info)

    convert = commands.add_parser("convert", help="read a material or a map and write another file")
    convert.add_argument(
        "source", help="name of a library material, .binary, .bsdf, .npz, .exr, .hdr or .pic"
    )
    convert.add_argument(
        "target", type=Path, help="material: .binary, .bsdf or .npz; map: .exr or .png"
    )
    convert.set_defaults(run=_convert)

    export = commands.add_parser("export", help="write a design for another program")
    export.add_argument("design", type=Path, help="a design saved as .tbr")
    export.add_argument(
        "target", type=Path,
        help="glTF .glb, MaterialX .mtlx (OpenPBR), or .py: a Mitsuba 3 scene with its tables",
    )  # fmt: skip
    export.add_argument(
        "--texture-size", type=int, default=1024, metavar="TEXELS",
        help="on a side, for parts that are painted locally (%(default)s)",
    )  # fmt: skip
    export.add_argument(
        "--picture", type=Path, metavar="PNG",
        help="also draw each part's material, and below it what the file says, as lit spheres",
    )  # fmt: skip
    export.set_defaults(run=_export)

    validate = commands.add_parser(
        "validate", help="say what is wrong with files, a line each; the exit status is 1 then"
    )
    validate.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="materials, maps, meshes and designs, by their suffixes",
    )  # fmt: skip
    validate.add_argument(
        "--to", type=float, default=80.0, metavar="DEGREES",
        help="greatest view angle at which materials must keep energy (%(default)s)",
    )  # fmt: skip
    validate.add_argument("--json", action="store_true", help="write a list of records instead")
    validate.set_defaults(run=_validate)

    ahead = commands.add_parser(
        "compile", help="compile what the first session would wait for; once, half a minute"
    )
    ahead.set_defaults(run=_compile)

    timing = commands.add_parser("bench", help="measure errors and times")
    timing.add_argument(
        "names", nargs="*", metavar="NAME",
        help=f"one or more of {', '.join(NAMES)} "
        f"(default: all but {', '.join(sorted(ON_REQUEST))})",
    )  # fmt: skip
    timing.add_argument(
        "--peers", action="store_true",
        help="compare with Mitsuba 3 at equal error; the same as the name 'peers' (some 10 "
        "minutes; needs traitbrdf[peers])",
    )  # fmt: skip
    timing.add_argument(
        "--trade", action="store_true",
        help="vary every knob of speed and accuracy, alone and together; the same as the name "
        "'trade' (some 10 minutes)",
    )  # fmt: skip
    timing.add_argument(
        "--out", type=Path, metavar="FOLDER",
        help="folder for trade.json, trade.png and live.png (plots need traitbrdf[plots])",
    )  # fmt: skip
    timing.add_argument("--quick", action="store_true", help="small sizes (some two minutes)")
    timing.add_argument("--json", type=Path, metavar="FILE", help="also write the records here")
    timing.add_argument(
        "--data", type=Path, help="folder with envmaps/ and rgl/ ($TRAITBRDF_SHARED)"
    )
    timing.set_defaults(run=_bench)
    return parser


def _add_scene(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", type=Path, help="HDR map (.exr, .hdr); default: a procedural sky")
    parser.add_argument("--shape", choices=("teapot", "sphere"), default="teapot")
    parser.add_argument(
        "--ground", type=float, nargs="?", const=2.0, default=0.0, metavar="RADIUS",
        help="radius of a ground disc, in radii of the shape; 2 if none is given; 0 is no ground "
        "(%(default)s)",
    )  # fmt: skip
    parser.add_argument("--size", type=_size, default=512, help="pixels (%(default)s)")
    parser.add_argument(
        "--camera", type=float, nargs=3, default=DEMO_CAMERA,
        metavar=("AZIMUTH", "ELEVATION", "ZOOM"), help="degrees, degrees, factor",
    )  # fmt: skip


def _size(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 8 <= value <= 4096:
        raise argparse.ArgumentTypeError(f"expected a whole number from 8 to 4096, got {text!r}")
    return value


def _trait(text: str) -> tuple[str, float]:
    name, _, amount = text.partition("=")
    try:
        value = float(amount)
    except ValueError:
        value = math.nan
    if not name or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected NAME=AMOUNT, as in shiny=0.6, got {text!r}")
    return name, value


def _scene(given: argparse.Namespace, mesh: Shape | None = None) -> tb.Scene:
    environment = (
        tb.EnvironmentMap.sky() if given.env is None else tb.EnvironmentMap.read(given.env)
    )
    shape = mesh
    if shape is None:
        shape = tb.teapot() if given.shape == "teapot" else tb.sphere()
    azimuth, elevation, zoom = given.camera
    if (given.shape == "sphere" or mesh is not None) and tuple(given.camera) == DEMO_CAMERA:
        zoom = 1.0
    camera = tb.Camera.orbit(azimuth, elevation, zoom=zoom)
    ground = given.ground if given.ground != 0.0 else False
    return tb.Scene(shape, environment, camera=camera, size=given.size, ground=ground)


def _write(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image to a path that `_check_out` has accepted."""
    if path.suffix.lower() == ".exr":
        write_exr(path, image)
    else:
        write_png(path, tone_map(image, exposure_of(image)))


def _check_out(path: Path) -> None:
    """Refuse an output that cannot be written, before any work is done."""
    if path.suffix.lower() not in (".png", ".exr"):
        raise ValueError(f"--out: expected a name that ends in .png or .exr, got {str(path)!r}")
    path.parent.mkdir(parents=True, exist_ok=True)


class _Progress:
    """Says on standard error what is being done: stage, share of it, and seconds since the start.

    On a terminal that is one line which changes. Elsewhere it is a line at each new stage, and
    every few seconds.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        """What each stage took."""
        self._terminal = sys.stderr.isatty()
        self._start = self._told = self._since = time.perf_counter()
        self._stage, self._fraction = "", 0.0
        self._lock, self._end = threading.Lock(), threading.Event()
        # a stage may report nothing for a while
        self._clock = threading.Thread(target=self._tick, name="traitbrdf-progress", daemon=True)

    def __enter__(self) -> _Progress:
        self._clock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._clock.join()
        self._count()
        if self._terminal:
            print("\r" + " " * 50 + "\r", end="", file=sys.stderr, flush=True)

    def __call__(self, stage: str, fraction: float) -> None:
        with self._lock:
            self._count()
            fresh = stage not in self.seconds
            self.seconds.setdefault(stage, 0.0)
            self._stage, self._fraction = stage, fraction
            if fresh or time.perf_counter() - self._told > self._pause:
                self._tell()

    @property
    def _pause(self) -> float:
        return 0.1 if self._terminal else 5.0

    def _count(self) -> None:
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] += now - self._since
        self._since = now

    def _tick(self) -> None:
        while not self._end.wait(0.5):
            with self._lock:
                if self._stage and time.perf_counter() - self._told > self._pause:
                    self._tell()

    def _tell(self) -> None:
        self._told = time.perf_counter()
        line = f"{self._stage}: {100 * self._fraction:.0f} %, {self._told - self._start:.0f} s"
        shown = f"\r{line:50}" if self._terminal else f"{line}\n"
        with contextlib.suppress(OSError):  # nobody reads it any longer
            print(shown, end="", file=sys.stderr, flush=True)


def _prepared(scene: tb.Scene, progress: _Progress) -> tb.EditSession:
    progress("loading", 0.0)
    session = tb.EditSession(scene, progress=progress)
    session.prepare()
    return session


def _compile(given: argparse.Namespace) -> int:
    start = time.perf_counter()
    with _Progress() as progress:
        progress("loading", 0.0)
        # imports torch, which most commands do not need
        from traitbrdf.session.warmup import warm_up

        fresh = warm_up(progress)
    what = "compiled what sessions run" if fresh else "all is compiled already"
    print(f"{what} ({time.perf_counter() - start:.1f} s)")
    return 0


def _demo(given: argparse.Namespace) -> int:
    given.out.mkdir(parents=True, exist_ok=True)
    tb.default_library().index(given.material)
    seconds: dict[str, float] = {}

    def step(name: str, start: float) -> float:
        now = time.perf_counter()
        seconds[name] = now - start
        return now

    # also into a file or a pipe, each line is written at once
    say = functools.partial(print, flush=True)
    start = clock = time.perf_counter()
    scene = _scene(given)
    coverage = scene.coverage  # casts rays
    clock = step("scene", clock)
    light = "a procedural sky" if given.env is None else given.env.name
    say(
        f"{given.shape} under {light}, {scene.width}x{scene.height}, "
        f"{100 * coverage:.0f} % covered ({seconds['scene']:.2f} s)"
    )
    with _Progress() as progress:
        session = _prepared(scene, progress)
    clock = step("preparation", clock)
    stages = ", ".join(f"{stage} {took:.1f} s" for stage, took in progress.seconds.items())
    say(f"light transport prepared ({seconds['preparation']:.1f} s: {stages})")
    session.assign(scene.shape.parts, given.material)
    before = session.render()
    clock = step("first frame", clock)
    say(f"all parts made of {given.material} ({1e3 * seconds['first frame']:.1f} ms)")
    part = "handle" if given.shape == "teapot" else "sphere"
    inside = scene.part_image == scene.parts.index(part)
    if not inside.any():
        raise ValueError(f"the {part} is not in view: choose another --camera")
    points, radius = follow(inside)
    stroke = tb.Stroke(points, trait="shiny", amount=DEMO_AMOUNT, radius=radius)
    clock = time.perf_counter()
    score = session.scores(part)["shiny"]
    moved = session.paint(stroke)
    risen = session.scores(part)["shiny"] - score
    clock = step("stroke", clock)
    after = session.render()
    step("frame after the stroke", clock)
    # a border pixel belongs to every part that it shows
    outside = np.ones(inside.shape, bool)
    outside.flat[scene.pixels[scene.part_slice(scene.parts.index(part))]] = False
    changed = int(np.count_nonzero((before != after).any(axis=-1) & outside))
    say(
        f"painted 'shiny' {DEMO_AMOUNT:+g} on "
        + ", ".join(f"the {name} ({amount:+.3f})" for name, amount in moved.items())
        + f" ({1e3 * seconds['stroke']:.2f} ms); its score rose by {risen:.3f}, "
        f"{100 * risen / DEMO_AMOUNT:.0f} % of what was asked for"
    )
    say(
        f"frame after the stroke: {1e3 * seconds['frame after the stroke']:.2f} ms; pixels "
        f"changed outside the {part}: {changed} of {int(outside.sum())}"
    )
    clock = time.perf_counter()
    report = session.report()
    say(
        f"frame error, measured on probe pixels (mean relative L1): "
        f"{100 * report['frame_error']:.3f} % of the whole frame, "
        f"{100 * report['parts'][part]['error']:.3f} % of the {part}"
    )
    exposure = exposure_of(before)
    pictures = tone_map(before, exposure), tone_map(after, exposure)
    write_png(given.out / "before.png", pictures[0])
    write_png(given.out / "after.png", pictures[1])
    drawn = _draw_stroke(pictures[0], stroke)
    write_png(given.out / "side_by_side.png", np.concatenate([drawn, pictures[1]], axis=1))
    write_exr(given.out / "after.exr", after)
    step("pictures", clock)
    report["demo"] = {
        "asked": DEMO_AMOUNT,
        "risen": risen,
        "changed_outside": changed,
        "seconds": seconds,
        "exposure": exposure,
    }
    (given.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    names = "before.png, after.png, side_by_side.png, after.exr, report.json"
    whole = time.perf_counter() - start
    say(
        f"wrote {names} to {given.out} after {whole:.1f} s: preparation "
        f"{seconds['preparation']:.1f} s, pictures {seconds['pictures']:.1f} s, all else "
        f"{whole - seconds['preparation'] - seconds['pictures']:.1f} s"
    )
    return 0


def _draw_stroke(picture: NDArray[np.uint8], stroke: tb.Stroke) -> NDArray[np.uint8]:
    """Return the picture with the stroke's brush laid over it in yellow."""
    cover = stroke.coverage(*picture.shape[:2])[..., None]
    yellow = np.array([255.0, 214.0, 10.0])
    alpha = np.where(cover > 0.0, 0.35 + 0.45 * cover, 0.0)
    blended: NDArray[np.uint8] = (picture * (1.0 - alpha) + yellow * alpha + 0.5).astype(np.uint8)
    return blended


def _add_hold(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--hold", action="append", metavar="NAME",
        help="what to hold constant: a trait, colour, lightness or body; may be repeated; "
        "'nothing' holds nothing (default: colour and lightness, unless a trait is about them)",
    )  # fmt: skip


def _hold(given: argparse.Namespace) -> tuple[str, ...] | None:
    return None if given.hold is None else tuple(h for h in given.hold if h != "nothing")


def _paint(given: argparse.Namespace) -> int:
    _check_out(given.out)
    scene = _scene(given)
    part = given.part or ("handle" if "handle" in scene.parts else scene.parts[0])
    session = tb.EditSession(scene)
    session.assign(scene.shape.parts, given.material)
    before = session.scores(part)
    session.move(part, hold=_hold(given), **dict(given.trait))
    after = session.scores(part)
    image = session.render()
    _write(given.out, image)
    if given.save:
        session.save(given.save)
    report = session.report()
    changes = ", ".join(f"{n} {before[n]:+.2f} -> {after[n]:+.2f}" for n, _ in given.trait)
    print(f"{part}: {changes}; frame error {100 * report['frame_error']:.3f} %; wrote {given.out}")
    return 0


def _render(given: argparse.Namespace) -> int:
    _check_out(given.out)
    if given.design is not None:
        session = tb.EditSession.load(given.design)
    else:
        material = _material(given.material)
        session = tb.EditSession(_scene(given))
        session.assign(session.scene.shape.parts, material)
    start = time.perf_counter()
    if given.reference:
        parts = session.scene.parts
        brdfs = {p: session.brdf(p) for p in parts}
        with _Progress() as progress:
            image = tb.reference.render(session.scene, brdfs, progress=progress)
        _write(given.out, image.astype(np.float32))
        error = "estimated error below 0.01 %"
    else:
        _write(given.out, session.render())
        error = f"frame error {100 * session.report()['frame_error']:.3f} %"
    print(f"{error}; {time.perf_counter() - start:.1f} s; wrote {given.out}")
    return 0


def _material(name: str) -> str | Reflectance:
    suffix = Path(name).suffix.lower()
    if suffix in (".binary", ".npz"):
        return tb.TabulatedBRDF.read(name)
    if suffix == ".bsdf":
        return tb.MeasuredBRDF.read(name)
    tb.default_library().index(name)
    return name


def _convert(given: argparse.Namespace) -> int:
    target: Path = given.target
    kind = target.suffix.lower()
    if Path(given.source).suffix.lower() in (".exr", ".hdr", ".pic"):
        if kind not in (".exr", ".png"):
            raise ValueError(f"target: expected a name in .exr or .png, got {str(target)!r}")
        image = read_image(given.source)
        target.parent.mkdir(parents=True, exist_ok=True)
        _write(target, image)
        print(f"{target}: {image.shape[0]} rows by {image.shape[1]} columns")
        return 0
    if kind not in SUFFIXES:
        raise ValueError(f"target: expected a name in {', '.join(SUFFIXES)}, got {str(target)!r}")
    brdf = _material(given.source)
    if isinstance(brdf, str):
        brdf = tb.default_library()[brdf]
    if not isinstance(brdf, tb.TabulatedBRDF):
        grid = tb.HalfDiffGrid.merl() if kind == ".binary" else tb.default_embedding().grid_
        brdf = tb.TabulatedBRDF.from_model(brdf, grid, Path(given.source).stem)
    target.parent.mkdir(parents=True, exist_ok=True)
    brdf.write(target)
    print(f"{target}: {brdf!r}")
    return 0


def _export(given: argparse.Namespace) -> int:
    session = tb.EditSession.load(given.design)
    given.target.parent.mkdir(parents=True, exist_ok=True)
    with _Progress() as progress:
        exported = session.export(given.target, given.texture_size, progress)
    print(exported)
    if given.picture is not None:
        given.picture.parent.mkdir(parents=True, exist_ok=True)
        write_png(given.picture, exported.picture(session.scene.environment))
    return 0


def _validate(given: argparse.Namespace) -> int:
    # imports the reference integrator, which most commands do not need
    from traitbrdf.testing import file_faults

    records = [{"file": str(f), "faults": file_faults(f, given.to)} for f in given.files]
    if given.json:
        print(json.dumps(records, indent=1))
    else:
        for record in records:
            for fault in record["faults"]:
                print(f"{record['file']}: {fault}")
    return int(any(record["faults"] for record in records))


def _angles(given: argparse.Namespace) -> int:
    # imports torch, which most commands do not need
    from traitbrdf.pictures import angle_map

    given.out.parent.mkdir(parents=True, exist_ok=True)
    seen = tb.EditSession(_scene(given)).angles(given.part)
    write_png(given.out, angle_map(seen))
    print(json.dumps(seen.as_dict(), indent=2))
    return 0


def _gallery(given: argparse.Namespace) -> int:
    environment = None if given.env is None else tb.EnvironmentMap.read(given.env)
    if given.brushes:
        # imports sessions, which most commands do not need
        from traitbrdf.session.gallery import EXAMPLES, brushes

        given.out.parent.mkdir(parents=True, exist_ok=True)
        with _Progress() as progress:
            picture = brushes(given.size or 200, environment, progress=progress)
        write_png(given.out, picture)
        print(f"{given.out}: {len(EXAMPLES)} examples")
        return 0
    # imports torch, which most commands do not need
    from traitbrdf.pictures import sheet

    library, space = tb.default_library(), tb.default_traits()
    traits = list(space.names) if "all" in given.trait else given.trait
    names = given.material or list(GALLERY)
    steps = given.amount or np.linspace(-1.0, 1.0, 7).tolist()
    for name in traits:
        space.index(name)
    held = _hold(given)
    for name in held or ():
        space.held(name)
    given.out.parent.mkdir(parents=True, exist_ok=True)  # fail before the work, not after it
    rows: dict[str, list[tb.TabulatedBRDF]] = {}
    columns = [f"{step:+.2f}" for step in steps] if traits else []
    if given.table:
        # a label is as wide as a sphere, so the material's name replaces the middle label
        middle = len(steps) // 2
        titles = [[*columns[:middle], name, *columns[middle + 1 :]] for name in names]
        columns = [label for title in titles for label in title] if traits else list(names)
    for name in names:
        z = library.coordinates[library.index(name)]
        for trait in traits:
            own = space.names[space.index(trait)]
            stay = None if held is None else [h for h in held if own not in space.held(h)]
            moved = [space.reach(z, {trait: step}, stay, method=given.method) for step in steps]
            label = trait if len(names) == 1 or given.table else f"{trait}: {name}"
            rows.setdefault(label, []).extend(library.embedding.decode(one.z) for one in moved)
            for one in moved:
                if one.stopped:
                    print(f"{name}: {one}")
        if not traits:
            rows.setdefault("" if given.table else name, []).append(library[name])
    write_png(given.out, sheet(rows, columns, environment, given.size or 96))
    print(f"{given.out}: {len(rows)} rows")
    return 0


def _studio(given: argparse.Namespace) -> int:
    need_packages()
    # imports a web server, which no other command needs
    from traitbrdf.studio.page import Server
    from traitbrdf.studio.session import Session

    if not 0 <= given.port <= 65535:
        raise ValueError(f"--port: expected 0 to 65535, got {given.port}")
    if given.design is not None:
        edit = tb.EditSession.load(given.design)
    else:
        shape = None if given.mesh is None else tb.load_mesh(given.mesh)
        edit = tb.EditSession(_scene(given, shape))
        edit.assign(list(edit.scene.shape.parts), given.material)
    session = Session(edit)
    server = Server(session, given.port)
    print(f"{server.url}\nCtrl+C stops it; designs are saved in {session.folder}", flush=True)
    if not given.no_browser:
        threading.Timer(0.5, webbrowser.open, (server.url,)).start()
    server.run()
    return 0


def _info(given: argparse.Namespace) -> int:
    library = tb.default_library()
    embedding, space = library.embedding, tb.default_traits()
    if given.file is None:
        kept = float(embedding.explained_variance_ratio_.sum())
        print(f"traitbrdf {tb.__version__}")
        print(f"library: {len(library)} materials of {len(set(library.families))} families")
        grey, colour = embedding.n_components
        print(
            f"embedding: {embedding.size} coordinates ({grey} grey, 2 x {colour} colour), "
            f"{100 * kept:.2f} % of the variance of log f, grid {embedding.grid_.shape}"
        )
        print(f"traits: {', '.join(space.names)}")
        print("materials: " + ", ".join(library.names))
        return 0
    # imports sessions, which most commands do not need
    from traitbrdf.facts import facts

    lines, picture = facts(given.file)
    print(f"{given.file}: " + "\n".join(lines))
    if given.picture is not None:
        if picture is None:
            raise ValueError(f"--picture: expected a material or a map, got {given.file!r}")
        given.picture.parent.mkdir(parents=True, exist_ok=True)
        write_png(given.picture, picture)
    return 0


def _bench(given: argparse.Namespace) -> int:
    # imports torch and everything else, which other commands do not need
    from traitbrdf.bench.datasets import default_data
    from traitbrdf.bench.live import live_edits
    from traitbrdf.bench.run import BENCHES, Bench, run
    from traitbrdf.bench.trade import trade

    benches: dict[str, Bench] = {
        **BENCHES,
        "live": functools.partial(live_edits, out=given.out),
        "trade": functools.partial(trade, out=given.out),
    }
    for name in given.names:
        if name not in benches:
            raise ValueError(unknown_name("bench", name, tuple(benches)))
    asked = [name for name in ("trade", "peers") if getattr(given, name)]
    names = [*given.names, *(name for name in asked if name not in given.names)]
    if given.data is not None and not given.data.is_dir():
        raise FileNotFoundError(f"--data: no such folder: {given.data}")
    if given.json is not None:
        given.json.parent.mkdir(parents=True, exist_ok=True)
    data = given.data or default_data()
    if data is None:
        print("no folder of real maps and materials: using the procedural sky, without RGL")
    records = run(names, data, given.quick, lambda line: print(line, flush=True), benches)
    if given.json is not None:
        given.json.write_text(json.dumps([r.as_dict() for r in records], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
