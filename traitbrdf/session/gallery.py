"""Before and after of every brush, slider and effect, with the calls that do it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from traitbrdf.design.colours import Colour, Highlight
from traitbrdf.design.effects import Assign, Effect, Move, Tint
from traitbrdf.design.parameters import Parameters
from traitbrdf.design.strokes import Stroke
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.scene.camera import Camera
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import sphere
from traitbrdf.scene.teapot import teapot
from traitbrdf.session.editing import EditSession
from traitbrdf.transport.visibility import Progress

_LINE = 13
_WORDS = 52  # characters in a line of a caption


class Place(NamedTuple):
    """Where examples paint: points of a stroke in pixels, its radius, and the part under it."""

    points: list[tuple[float, float]]
    radius: float
    part: str

    def stroke(self, **settings: object) -> Stroke:
        """Return the stroke, with other settings."""
        return Stroke(self.points, radius=self.radius, **settings)  # type: ignore[arg-type]


Act: TypeAlias = Callable[[EditSession, Place], None]


class Example(NamedTuple):
    """One thing that can be done.

    Attributes
    ----------
    title : str
    act : callable
        Does it to a session of red rubber.
    material : str
        What the object is made of before.
    """

    title: str
    act: Act
    material: str = "red-rubber"


def _local(effect: Effect, **settings: object) -> Act:
    return lambda edit, at: _ignore(edit.paint(at.stroke(**settings), effect, where="local"))


def _whole(effect: Effect) -> Act:
    return lambda edit, at: edit.apply(at.part, effect)


def _parameters(model: str, **values: Any) -> Act:
    return lambda edit, at: edit.set_parameters(at.part, model, **values)


def _created(edit: EditSession, at: Place) -> None:
    edit.highlight(at.points[1], intensity=1.0, width=10.0, radius=2.0 * at.radius)


def _ignore(_: object) -> None:
    """Forget what a call returns."""


def _erased(edit: EditSession, at: Place) -> None:
    edit.paint(at.stroke(), Assign("gold-polished"), where="local")
    middle = at.points[len(at.points) // 2 : len(at.points) // 2 + 1]
    edit.layers[-1].erase(Stroke(middle, radius=0.7 * at.radius))


def _inverted(edit: EditSession, at: Place) -> None:
    edit.paint(at.stroke(), Tint((0.3, 0.5, 1.0)), where="local")
    edit.layers[-1].invert()


def _faint(edit: EditSession, at: Place) -> None:
    edit.paint(at.stroke(), Assign("gold-polished"), where="local")
    edit.layers[-1].opacity = 0.4


def _changed(edit: EditSession, at: Place) -> None:
    edit.paint(at.stroke(), Move(shiny=0.7), where="local")
    edit.layers[-1].effect = Move(metallic=0.7)


def _stacked(edit: EditSession, at: Place) -> None:
    edit.paint(at.stroke(), Move(shiny=0.7), where="local")
    x, y = at.points[1]
    down = [(x, y - 2.0 * at.radius), (x, y + 2.0 * at.radius)]
    edit.paint(Stroke(down, radius=at.radius), Tint((0.3, 0.5, 1.0)), where="local")


EXAMPLES: tuple[Example, ...] = (
    Example("slider: a trait of a part", _whole(Move(shiny=0.7))),
    Example(
        "brush: a trait of the parts it touches",
        lambda edit, at: _ignore(edit.paint(at.stroke(trait="shiny", amount=0.7))),
    ),
    Example("local brush: a trait", _local(Move(shiny=0.7))),
    Example("local brush, hard", _local(Move(shiny=0.7), hardness=1.0)),
    Example("local brush, half the flow", _local(Assign("gold-polished"), flow=0.5)),
    Example("local brush, pen pressure", _local(Assign("gold-polished"), pressure=[0.1, 0.5, 1.0])),
    Example("local brush: a material", _local(Assign("gold-polished"))),
    Example("local brush: tint of the body", _local(Tint((0.3, 0.5, 1.0)))),
    Example(
        "local brush: tint of reflections",
        _local(Tint((1.0, 0.7, 0.2), "reflections")), "silver-polished",
    ),
    Example("draw colour", _local(Colour("#2060c0"))),
    Example("change the overall colour", lambda edit, at: edit.set_colour(at.part, "#2060c0")),
    Example("highlight created", _created),
    Example("highlight spread: blur", _whole(Highlight(blur=2.0)), "blue-plastic"),
    Example("highlight spread: sharpen", _whole(Highlight(blur=0.4)), "blue-plastic"),
    Example("highlight sharpened locally", _local(Highlight(blur=0.3)), "blue-plastic"),
    Example("highlight intensity: twice", _whole(Highlight(intensity=2.0)), "blue-plastic"),
    Example("highlight intensity: de-intensify", _whole(Highlight(intensity=0.2)), "blue-plastic"),
    *(
        Example(f"parameters: {name}", _parameters(model, **values))
        for name, model, values in (
            ("Phong", "phong", {}),
            ("Phong, roughness", "phong", {"roughness": 0.05}),
            ("Phong, specular intensity", "phong", {"specular": 0.7, "diffuse": (0.3, 0.3, 0.3)}),
            ("Phong, overall scaling", "phong", {"scale": 0.5}),
            ("Phong, diffuse red, green, blue", "phong", {"diffuse": (0.1, 0.3, 0.6)}),
            ("Torrance-Sparrow", "torrance-sparrow", {}),
            ("Torrance-Sparrow, roughness", "torrance-sparrow", {"roughness": 0.05}),
            ("GGX metal", "GGX", {"alpha": 0.15, "eta": 0.2, "k": 3.0}),
            ("velvet", "Sheen", {}),
        )
    ),
    Example(
        "parameters painted", _local(Parameters("phong", roughness=0.05, diffuse=(0.1, 0.3, 0.6)))
    ),
    Example("eraser", _erased),
    Example("inverted mask", _inverted),
    Example("opacity of a layer", _faint),
    Example("effect changed after painting", _changed),
    Example("two layers", _stacked),
)  # fmt: skip


def sessions(
    size: int, environment: EnvironmentMap | None = None, progress: Progress | None = None
) -> list[tuple[EditSession, Place]]:
    """Return prepared sessions of a sphere and a teapot, and where examples paint on them.

    Parameters
    ----------
    size : int
        Pixels on a side.
    environment : EnvironmentMap or None
        None is a sky.
    progress : called with (stage, fraction done); may raise to cancel
    """
    made = []
    for shape, camera, part, line, radius in (
        (sphere(), Camera.orbit(0.0, 10.0), "sphere", [(0.3, 0.6), (0.5, 0.5), (0.7, 0.6)], 0.13),
        (teapot(), Camera.orbit(-35.0, 20.0, zoom=1.2), "body",
         [(0.3, 0.55), (0.5, 0.6), (0.66, 0.52)], 0.1),
    ):  # fmt: skip
        scene = Scene(shape, environment, camera=camera, size=size)
        edit = EditSession(scene, progress=progress)
        edit.prepare()
        points = [(round(x * size, 1), round(y * size, 1)) for x, y in line]
        made.append((edit, Place(points, round(radius * size, 1), part)))
    return made


def brushes(
    size: int = 200,
    environment: EnvironmentMap | None = None,
    examples: Sequence[Example] = EXAMPLES,
    progress: Progress | None = None,
) -> NDArray[np.uint8]:
    """Draw before and after of each example, on a sphere and a teapot, with the calls that do it.

    Parameters
    ----------
    size : int
        Pixels of each frame's side.
    environment : EnvironmentMap or None
        None is a sky.
    examples : sequence of Example
    progress : called with (stage, fraction done); may raise to cancel

    Returns
    -------
    (H, W, 3) uint8 sRGB
    """
    made = sessions(size, environment, progress)
    rows = []
    for done, example in enumerate(examples):
        if progress is not None:
            progress("painting", done / len(examples))
        shown, calls = [], []
        for edit, at in made:
            while edit.undo():
                pass
            edit.assign(edit.scene.parts, example.material)
            before = edit.render()
            count = len(edit.history)
            example.act(edit, at)
            after = edit.render()
            exposure = exposure_of(before)
            shown += [tone_map(image, exposure) for image in (before, after)]
            calls = edit.history[count:]
        text = [line for call in calls for line in textwrap.wrap(call, _WORDS) or [""]]
        rows.append((example.title, text, shown))
    wide, column = 4 * size, 6 * _WORDS
    tall = max(size, *(_LINE * (len(text) + 2) for _, text, _ in rows)) + 6
    halves = -(-len(rows) // 2)
    paper = Image.new("RGB", (2 * (wide + column), halves * tall), (255, 255, 255))
    draw = ImageDraw.Draw(paper)
    for place, (title, text, shown) in enumerate(rows):
        across, down = divmod(place, halves)
        left, top = across * (wide + column), down * tall
        for i, image in enumerate(shown):
            paper.paste(Image.fromarray(image), (left + i * size, top))
        draw.text((left + wide + 8, top + 2), title, fill=(0, 0, 0))
        for i, line in enumerate(text):
            draw.text((left + wide + 8, top + _LINE * (i + 1) + 4), line, fill=(40, 60, 140))
    return np.asarray(paper)
