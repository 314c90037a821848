"""EditSession: a design shown live, edited by traits.

Every part (region) of the shape has one material. Edits are layers of a design, each an effect
under a mask; `traitbrdf.design.document` computes from them what the parts are made of, and undoes
and redoes them one at a time. `traitbrdf.session.viewer` prepares the scene and draws it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, NoReturn, Unpack

import numpy as np
from numpy.typing import NDArray

from traitbrdf.arguments import number, whole
from traitbrdf.design.colours import Colour
from traitbrdf.design.document import Design, Document, Varying
from traitbrdf.design.effects import Assign, Assignable, Effect, Move, Palette, names_of
from traitbrdf.design.layers import Layer
from traitbrdf.design.masks import Brushed, Framing, Local, Painted, Parts, Seen, Target
from traitbrdf.design.parameters import Parameters
from traitbrdf.design.stack import Layers
from traitbrdf.design.storage import SETTINGS, Stored, reading, write_design
from traitbrdf.design.strokes import Stroke, region_weights
from traitbrdf.design.surface import touched
from traitbrdf.export.files import Exported, export_design
from traitbrdf.host import steady_in_threads
from traitbrdf.reflectance.brdf import Reflectance, TabulatedBRDF
from traitbrdf.scene.camera import image_size
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.session.budget import quality_for
from traitbrdf.session.frames import View
from traitbrdf.session.picking import Picked, lobe_at, pick, white_at
from traitbrdf.session.preparation import EXACT_ABOVE
from traitbrdf.session.report import part_report, view_report
from traitbrdf.session.settings import Asked, Settings
from traitbrdf.session.sheets import Sheet
from traitbrdf.session.viewer import Viewer
from traitbrdf.space.learning import Trait
from traitbrdf.space.library import Library, default_library
from traitbrdf.space.material import Material
from traitbrdf.space.moves import Moved
from traitbrdf.space.traits import TraitSpace, default_traits
from traitbrdf.transport.transport import Transport
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
_FIRST_MATERIAL = "white-plastic"
_FIRST_GROUND = "concrete"
_MEASURED = 256  # fragments at which the error of local paint is measured; few err much


@steady_in_threads
class EditSession(Viewer):
    """Materials of a scene's parts, edited by traits, rendered in real time.

    Parameters
    ----------
    scene : Scene
    quality : str or None
        See `Settings`. None is what `error` needs, or "interactive" without one.
    library, traits : Library, TraitSpace
        What to edit with; None is what the package ships.
    progress : callable or None
        Called with (stage, fraction) while the scene is prepared, from the thread that prepares; it
        may raise to cancel.
    transport : Transport or None
        A prepared transport of this very scene; None prepares the scene when needed.
    **asked
        What is asked for: error, fps, device, seed, cache; see `Settings`.

    Attributes
    ----------
    settings : Settings

    Raises
    ------
    TypeError, ValueError
        If `scene` is no Scene, `transport` belongs to another one, or as `Settings` does.

    Notes
    -----
    The scene is prepared at the first `render`, or by `prepare`, in the background if wanted;
    `draft` gives a first image at once. Every method may be called from any thread.
    """

    def __init__(
        self,
        scene: Scene,
        quality: str | None = None,
        *,
        library: Library | None = None,
        traits: TraitSpace | None = None,
        progress: Progress | None = None,
        transport: Transport | None = None,
        **asked: Unpack[Asked],
    ) -> None:
        quality = quality_for(asked.get("error")) if quality is None else quality
        super().__init__(scene, Settings(quality, **asked), progress, transport)
        library = default_library() if library is None else library
        palette = Palette(library, default_traits() if traits is None else traits)

        def first(name: str) -> Material:
            return Material.of_library(name if name in library else library.names[0], library)

        materials = dict.fromkeys(scene.parts, first(_FIRST_MATERIAL))
        if scene.ground:
            materials[scene.parts[-1]] = first(_FIRST_GROUND)
        self._document = Document(Design(materials), palette)

    def __repr__(self) -> str:
        count = len(self.design.layers)
        return f"EditSession({self.scene!r}, quality={self.quality!r}, {count} layers)"

    @property
    def library(self) -> Library:
        """The library whose members can be assigned by name."""
        return self._document.palette.library

    @property
    def traits(self) -> TraitSpace:
        """The traits that can be moved; setting them applies all layers anew."""
        return self._document.palette.traits

    @traits.setter
    def traits(self, traits: TraitSpace) -> None:
        with self._lock:
            self._document.palette = Palette(self.library, traits)

    # -- materials ------------------------------------------------------------------------------

    @property
    def materials(self) -> Mapping[str, Material]:
        """The material of every part where nothing is painted locally, all other layers counted."""
        return self._document.materials

    @property
    def varying(self) -> Mapping[str, Varying]:
        """How the material of parts that are painted locally varies, by part."""
        found = {part: self._document.varying(part) for part in self.scene.parts}
        return {part: one for part, one in found.items() if one is not None}

    def material(self, part: str) -> Material:
        """Return the material of a part.

        Parameters
        ----------
        part : str
            Its name.
        """
        self.part(part)
        return self.materials[part]

    def scores(self, part: str) -> dict[str, float]:
        """Return every trait's score of a part's material.

        Parameters
        ----------
        part : str
            Its name.
        """
        return self.traits.score(self.material(part).z)

    def brdf(self, part: str, at: tuple[float, float] | None = None) -> TabulatedBRDF:
        """Return a part's material as a table; ``.write("x.binary")`` saves it.

        Parameters
        ----------
        part : str
            Its name.
        at : (x, y) or None
            In pixels, where the part is seen: the material there, local paint included. None is
            the material where nothing is painted locally.

        Raises
        ------
        ValueError
            If the part is not seen there.
        """
        material = self.material(part)
        if at is not None:
            if len(at) != 2:
                raise ValueError(f"at: expected (x, y) in pixels, got {at!r}")
            seen = self.pick(*at)
            if seen is None or seen.part != part:
                other = "nothing" if seen is None else repr(seen.part)
                raise ValueError(f"at: expected a pixel that shows {part!r}, got {other} at {at}")
            material = seen.material
        return material.as_table(self.embedding, part)

    def pick(self, x: float, y: float) -> Picked | None:
        """Return what is seen at a place of the image; None where no part is.

        Parameters
        ----------
        x, y : float
            Pixels from the top left corner.

        Examples
        --------
        >>> print(edit.pick(64, 70))  # doctest: +SKIP
        body: red-rubber; layers: 0 'base', 2 (40 %)
        """
        with self._lock:
            return pick(self.scene, (number(x, "x"), number(y, "y")), self._document, self.traits)

    def plausibility(self, part: str) -> dict[str, float]:
        """Return ``energy_scale``, ``gamut_margin`` and ``plausibility`` as `report` has them.

        Parameters
        ----------
        part : str
            Its name.
        """
        material = self.material(part)
        span = np.maximum(self.embedding.high_ - self.embedding.low_, 1e-12)
        inside = (material.z - self.embedding.low_) / span
        return {
            "energy_scale": material.energy_scale(self.embedding),
            "gamut_margin": float(np.minimum(inside, 1.0 - inside).min()),
            "plausibility": self.traits.plausibility(material.z),
        }

    # -- edits ----------------------------------------------------------------------------------

    def assign(self, part: Target, material: Assignable) -> None:
        """Give one part (or several) a material: a new layer of `tb.Assign`.

        Parameters
        ----------
        part : name or names of parts, or a weight in [0, 1] for each
        material : a library name, a `TabulatedBRDF`, a model or measured BRDF, or coordinates (k,)

        Raises
        ------
        ValueError
            On an unknown part or material, or coordinates of a wrong shape.
        TypeError
            On something that is no material.
        """
        self.apply(part, Assign(material))

    def move(
        self,
        part: Target,
        amounts: Mapping[str, float] | None = None,
        /,
        hold: Iterable[str] | None = None,
        photoreal: bool = True,
        **more: float,
    ) -> None:
        """Change traits of parts: ``edit.move("handle", shiny=0.6)``, a new layer of `tb.Move`.

        Parameters
        ----------
        part : name or names of parts, or a weight in [0, 1] for each
        amounts : mapping of trait to amount
            For traits whose names are no Python identifiers; others may be keywords.
        hold : iterable of str, or None
            What stays constant: traits, "colour", "lightness", "body"; () is nothing. None is
            `TraitSpace.holds`: colour, unless a trait is a colour itself, and lightness, unless a
            trait is about it.
        photoreal : bool
            Whether to stay near materials of the library; `plausibility` measures that.
        **more : float
            For each trait, how much its score shall change (1: typically low to high).

        Raises
        ------
        ValueError, TypeError
            On unknown names, amounts that are not finite, or holds that forbid the move. Nothing
            is changed then.

        Notes
        -----
        If the whole amount cannot be reached, the material moves as far as it can; `reached`
        returns how far that is, and why.
        """
        move = Move(amounts, hold=hold, photoreal=photoreal, **more)
        self._add(Layer(move, Parts.of(part)), check=True)

    def set_parameters(
        self,
        part: Target,
        model: str | Mapping[str, Any] | None = None,
        values: Mapping[str, Any] | None = None,
        /,
        **more: Any,
    ) -> None:
        """Set parameters of closed forms: ``edit.set_parameters("lid", "GGX", alpha=0.1)``.

        Parameters
        ----------
        part : name or names of parts, or a weight in [0, 1] for each
        model : str, optional
            What the material becomes; left out, it has to be a closed form already.
        values : mapping of name to value, optional
            For names that are no Python identifiers, such as "base.alpha".
        **more : float or (3,) array_like
            A value for each named parameter. A new layer of `tb.Parameters` sets them.

        Raises
        ------
        ValueError, TypeError
            As `tb.Parameters` does, and where a material is no closed form, has no parameter of
            such a name, or does not accept the value. Nothing is changed then.
        """
        self._add(Layer(Parameters(model, values, **more), Parts.of(part)), check=True)

    def set_colour(self, part: Target, rgb: Sequence[float] | str, space: str = "linear") -> None:
        """Give bodies exactly a colour: ``edit.set_colour("lid", "#b03030")``.

        Parameters
        ----------
        part : name or names of parts, or a weight in [0, 1] for each
        rgb, space
            As `tb.Colour` has them.

        Raises
        ------
        ValueError, TypeError
            On an unknown part, as `tb.Colour` does, or where body and reflections would reflect
            more light than arrives; the message names the nearest colour. Nothing is changed then.
        """
        self._add(Layer(Colour(rgb, space), Parts.of(part)), check=True)  # type: ignore[arg-type]

    def highlight(
        self,
        at: tuple[float, float],
        intensity: float = 1.0,
        width: float = 8.0,
        radius: float = 24.0,
        rgb: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> float:
        """Create a highlight at a place of the image, under the present light: a local layer.

        Parameters
        ----------
        at : (x, y) in pixels
        intensity : float
            Radiance that is added there, as a share of what a white matte surface would show.
        width : float
            Full width of the lobe at half its height, in degrees of theta_h.
        radius : float
            Of the soft stroke that it is painted with, in pixels.
        rgb : (3,)
            Its colour, linear Rec.709 in [0, 1].

        Returns
        -------
        float
            The intensity that is reached: less than asked for where more would reflect more light
            than arrives.

        Raises
        ------
        ValueError
            If no part is seen there, no light arrives, or a number is out of range.
        """
        with self._prepared() as (view, transport):
            effect = lobe_at(view.scene, transport, at, intensity, width, rgb)
            before = self._frame(view, transport)
            stroke = Stroke([at], radius=radius, hardness=0.0)
            self.paint(stroke, effect, where="local")
            self.prepare()  # the ground may have been prepared for one material
            y, x = int(at[1]), int(at[0])
            added = float((self.render() - before)[y, x].mean())
            return added / white_at(view.scene, transport, at)

    def apply(self, part: Target, effect: Effect) -> None:
        """Put a layer of any effect on parts: ``edit.apply("handle", tb.Move(shiny=0.6))``.

        Parameters
        ----------
        part : name or names of parts, or a weight in [0, 1] for each
        effect : Effect

        Raises
        ------
        ValueError, TypeError
            On an unknown part, or as the effect does. Nothing is changed then.

        Notes
        -----
        A move that held traits forbid becomes a layer that does nothing, until the layers below it
        change; `move` refuses it. So do parameters that the material below lacks, which
        `set_parameters` refuses.
        """
        self._add(Layer(effect, Parts.of(part)))

    def paint(
        self,
        stroke: Stroke,
        effect: Effect | None = None,
        only: str | Iterable[str] | None = None,
        where: str = "part",
        across: bool = False,
        framing: Seen | None = None,
    ) -> dict[str, float]:
        """Paint on the image: a new layer.

        Parameters
        ----------
        stroke : Stroke, in pixels of this scene's image
        effect : Effect; None is a move of the stroke's own trait
        only : part or parts that may change, as if there were no others; None is all
        where : "part" or "local"
            With "part", every part under the stroke is changed as a whole, by its share of the
            stroke. With "local", the surface under the brush is changed, softly; further strokes go
            onto the same layer by ``edit.layers[-1].paint``.
        across : bool
            Whether paint of a local stroke flows from the parts that the brush touches to others.
        framing : (Camera, (height, width)) or None
            Of the image that a local stroke was drawn on; None is the scene's.

        Returns
        -------
        dict
            For each touched part, the amount by which the stroke's trait was moved, at most; with
            an `effect`, the part's weight.

        Raises
        ------
        TypeError, ValueError
            If the stroke touches no part, if there is neither or both of a trait and an effect, or
            as the effect does. Nothing is changed then.
        """
        if where not in ("part", "local"):
            raise ValueError(f"where: expected 'part' or 'local', got {where!r}")
        if not isinstance(stroke, Stroke):
            raise TypeError(f"stroke: expected a Stroke, got {stroke!r}")
        if (effect is None) == (stroke.trait is None):
            given = "neither" if effect is None else "both"
            raise ValueError(f"stroke: expected one with a trait, or an effect; got {given}")
        amount, own = 1.0, effect is None
        if effect is None and stroke.trait is not None:
            self.traits.index(stroke.trait)
            effect, amount = Move({stroke.trait: stroke.amount}, hold=stroke.hold), stroke.amount
        with self._lock:
            if where == "local":
                drawn = self._brushed(stroke, False, across, framing)
                limit = None if only is None else names_of(only, "only")
                local = Local((drawn,), self.scene.parts, only=limit)
                self._add(Layer(effect, local), check=own)  # type: ignore[arg-type]
                return dict.fromkeys(local.parts, float(amount))
            mask = self._mask(stroke, only)
            self._add(Layer(effect, mask), check=own)  # type: ignore[arg-type]
        return {part: float(amount * weight) for part, weight in mask.weights}

    def _brushed(self, stroke: Stroke, erase: bool, across: bool, framing: Seen | None) -> Brushed:
        """Put a stroke on the surface."""
        if not isinstance(stroke, Stroke):
            raise TypeError(f"stroke: expected a Stroke, got {stroke!r}")
        scene = self.scene
        seen = Framing.of(scene)
        if framing is not None:
            seen = Framing(framing[0], *image_size(framing[1]))
        bare = replace(stroke, trait=None, amount=0.0, hold=None)
        parts = touched(scene, bare, seen)
        if not parts:
            raise ValueError(
                "stroke: expected a stroke that touches the object, got one that lies beside "
                f"it (image {seen.width} x {seen.height}, {len(stroke.points)} points)"
            )
        return Brushed(bare, seen, scene.parts if across else parts, erase, across)

    def _mask(self, stroke: Stroke, only: str | Iterable[str] | None) -> Painted:
        """Weigh the parts under a stroke by their share of it."""
        scene = self.scene
        region = scene.part_image
        if only is not None:
            only = names_of(only, "only")
            free = [self.part(name) for name in only]
            region = np.where(np.isin(region, free), region, -1)
        cover = stroke.coverage(scene.height, scene.width)
        shares = region_weights(cover, region, len(scene.parts))
        weights = tuple(
            (name, float(share))
            for name, share in zip(scene.parts, shares, strict=True)
            if share > 0.0
        )
        if not weights:
            raise ValueError(
                "stroke: expected a stroke that touches the object, got one that lies beside "
                f"it (image {scene.width} x {scene.height}, {len(stroke.points)} points)"
            )
        bare = Stroke(stroke.points, radius=stroke.radius)
        return Painted(weights, bare, Framing.of(scene), only)

    def _add(self, layer: Layer, check: bool = False) -> None:
        with self._lock:
            for part in layer.mask.parts:
                self.part(part)
            self._document.add(layer, check)
            self._edited |= layer.anywhere

    def _change(self, change: Callable[[Design], Design]) -> None:
        with self._lock:
            self._document.change(change(self.design))
            self._edited |= self.design.touched()

    def reached(self, part: str) -> Moved | None:
        """Return how far the top layer moved a part's traits; None if it did not move any.

        Parameters
        ----------
        part : str
            Its name.
        """
        self.part(part)
        applied = self._document.applied.get(part)
        return None if applied is None else applied.moved

    def add_trait(self, trait: Trait) -> None:
        """Add a trait of one's own to paint and move with; it is saved with the design.

        Parameters
        ----------
        trait : Trait
            It replaces a trait of the same name; layers that move that one are applied anew.
        """
        with self._lock:
            self.traits = self.traits.with_trait(trait, self.library)

    # -- the design -----------------------------------------------------------------------------

    @property
    def design(self) -> Design:
        """Materials and layers as one immutable value; setting another one is undoable."""
        return self._document.design

    @design.setter
    def design(self, design: Design) -> None:
        if not isinstance(design, Design):
            raise TypeError(f"design: expected a Design, got {design!r}")
        self._change(lambda _: design)

    @property
    def layers(self) -> Layers:
        """The stack of layers, the lowest first: ``edit.layers[1].opacity = 0.3``; undoable."""
        return Layers(lambda: self.design, self._change, self._brushed)

    @property
    def tables(self) -> dict[str, Reflectance]:
        """The tables that layers assign, by the names that `history` has for them."""
        return self.design.tables()

    def undo(self) -> bool:
        """Take the last change of the design back; False if there is none."""
        with self._lock:
            return self._document.undo()

    def redo(self) -> bool:
        """Make the last undone change again; False if there is none."""
        with self._lock:
            return self._document.redo()

    @property
    def last(self) -> object:
        """The present design if there is a change to undo, else None.

        It tells whether another change has come since.
        """
        return self.design if self.undoable else None

    @property
    def undoable(self) -> bool:
        """Whether there is a change to undo."""
        return self._document.undoable

    @property
    def redoable(self) -> bool:
        """Whether there is an undone change to make again."""
        return self._document.redoable

    @property
    def history(self) -> list[str]:
        """The Python statements that make the design, in order.

        Executed on a fresh session of the same scene, library and traits, with the names ``tb``
        (this package), ``edit`` (the session) and ``tables`` (`tables`), they give the identical
        frame. What was undone or deleted is not among them. Strokes that were painted on the image
        of another camera or size are told as the parts that they touched.
        """
        with self._lock:
            return self._document.history(Framing.of(self.scene))

    def before(self) -> Float32:
        """Return the frame (H, W, 3) as it would be without any layer; nothing is changed."""
        # a ground that has a new material had another one before
        self._edited |= {part for layer in self.design.layers for part in layer.mask.parts}
        with self._prepared() as (view, transport):
            materials = [self.design.materials[part] for part in view.scene.parts]
            return self.renderer.frame(view, transport, materials, exact=False)

    # -- sheets ---------------------------------------------------------------------------------

    def wedge(
        self,
        trait: str,
        count: int = 7,
        part: Target | None = None,
        low: float = -1.0,
        high: float = 1.0,
    ) -> Sheet:
        """Show a trait in even steps on one's own object; nothing is changed.

        Parameters
        ----------
        trait : str
        count : int
            Frames, at least 2.
        part : name or names of parts, or a weight in [0, 1] for each; None is the whole shape
        low, high : float
            Amounts of the first and the last frame.

        Raises
        ------
        ValueError
            On an unknown name or a smaller count.
        """
        self.traits.index(trait)
        count = whole(count, "count", 2)
        amounts = np.linspace(low, high, count)
        moves = [Move({trait: float(amount)}) for amount in amounts]
        return self._sheet(moves, [f"{trait} {a:+.2f}" for a in amounts], part, count)

    def variations(
        self,
        count: int = 9,
        part: Target | None = None,
        amount: float = 0.5,
        seed: int = 0,
    ) -> Sheet:
        """Show the object with random moves of two traits each; nothing is changed.

        Parameters
        ----------
        count : int
            Frames; ``sheet.take(3)`` makes the fourth the design.
        part : name or names of parts, or a weight in [0, 1] for each; None is the whole shape
        amount : float
            Of each trait, up or down.
        seed : int

        Raises
        ------
        ValueError
            On an unknown part, or a count below 1.
        """
        count = whole(count, "count", 1)
        rng = np.random.default_rng(seed)
        moves, labels = [], []
        for _ in range(count):
            names = rng.choice(self.traits.names, 2, replace=False)
            amounts = {str(name): float(amount * rng.choice((-1.0, 1.0))) for name in names}
            moves.append(Move(amounts))
            labels.append(", ".join(f"{name} {value:+.1f}" for name, value in amounts.items()))
        return self._sheet(moves, labels, part, math.ceil(math.sqrt(count)))

    def _sheet(
        self, effects: Sequence[Effect], labels: Sequence[str], part: Target | None, columns: int
    ) -> Sheet:
        """Show what effects come to."""
        mask = Parts.of(self.scene.shape.parts if part is None else part)
        self._edited |= set(mask.parts)
        designs = tuple(self.design.with_layer(Layer(effect, mask)) for effect in effects)
        images = []
        with self._prepared() as (view, transport):
            for design in designs:
                document = self._document.copy()
                document.change(design)
                materials = [document.materials[name] for name in view.scene.parts]
                found = {name: document.varying(name) for name in view.scene.parts}
                varying = {name: one for name, one in found.items() if one is not None}
                frame = self.renderer.frame(view, transport, materials, False, varying)
                images.append(frame)
        return Sheet(tuple(images), tuple(labels), designs, self._choose, columns)

    def _choose(self, design: Design) -> None:
        self.design = design

    def under(
        self,
        environments: Mapping[str, EnvironmentMap],
        draft: bool = False,
    ) -> Sheet:
        """Show the design under several lights at once; nothing is changed.

        Parameters
        ----------
        environments : mapping of label to EnvironmentMap
        draft : bool
            Whether small, inexact frames will do, which take a second each. Finished ones have to
            be prepared unless they are in the cache.

        Raises
        ------
        ValueError, TypeError
            On no map, or something that is none.
        """
        if not isinstance(environments, Mapping):
            raise TypeError(f"environments: expected maps by name, got {environments!r}")
        if not environments:
            raise ValueError("environments: expected at least one map, got none")
        images = []
        for light in environments.values():
            other = EditSession(
                self.scene.changed(environment=light), self.quality, library=self.library,
                traits=self.traits, error=self.error, fps=self.fps, seed=self.seed,
                device=self.device, cache=self.settings.cache, progress=self.progress,
            )  # fmt: skip
            other.design = self.design
            images.append(other.draft()[0] if draft else other.render())
        designs = (self.design,) * len(images)
        return Sheet(tuple(images), tuple(environments), designs, self._choose, exposures="each")

    def copy_look(self, source: str, target: Target, at: tuple[float, float] | None = None) -> None:
        """Give parts the look of another part, or of a place that is painted locally.

        Parameters
        ----------
        source : str
            Name of the part to copy from.
        target : name or names of parts, or a weight in [0, 1] for each
        at : (x, y) or None
            As for `brdf`.

        Raises
        ------
        ValueError
            As `brdf` does, or on an unknown part.
        """
        material = self.material(source)
        if at is not None:
            seen = self.pick(*at)
            if seen is None or seen.part != source:
                raise ValueError(f"at: expected a pixel that shows {source!r}, got {at}")
            material = seen.material
        plain = material.offset is None and material.table is None and not material.mirror.any()
        given = material.z.tolist() if plain else self.brdf(source, at)
        self.assign(target, given)

    # -- reports --------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """Return what was measured, as a JSON-serialisable dict; render a frame first if needed.

        ``frame_error`` is the mean relative L1 over all covered pixels, measured at the probe
        pixels, whose exact rows are kept. ``parts`` has for each part

        - its ``error`` and ``tier``: "basis", "trained" (the basis, after exact images were added
          to it) or "exact" (without the basis),
        - the trait ``scores`` of its coordinates,
        - ``energy_scale``, the factor by which the table was lowered to keep its albedo within 1;
          below 1 it shows less of its traits than the scores say,
        - ``max_albedo``, the largest directional albedo,
        - ``gamut_margin``, the distance of the coordinates from the wall of the gamut box: 0 on it,
          0.5 in the middle; the smallest coordinate counts,
        - ``plausibility``, the share of the library that is less plausible,
        - ``move``, what the top layer asked of the part's traits and how far it came.

        ``painted`` is None, or the error of all that is painted locally, measured at some of its
        fragments (their number is ``fragments``) against exact rows and exact materials.

        ``exact_frames`` counts exact frames, ``trained_images`` the images added to bases.
        ``promise`` is what was picked for the error or speed asked for, and what was measured then
        (`traitbrdf.session.budget.Promise`). ``left_out`` is what the frame did not need, and what
        that saved, measured both ways at this call.
        """
        with self._prepared() as (view, transport):
            materials = [self.materials[part] for part in view.scene.parts]
            fresh = len(view.shown) < len(materials) or any(
                view.kept.get((i, m)) is not view.shown[i] for i, m in enumerate(materials)
            )
            if fresh:
                self._frame(view, transport)
            return {
                "quality": self.quality,
                "error_asked": EXACT_ABOVE if self.error is None else self.error,
                **view_report(view, transport, materials, self.embedding, self.device),
                "parts": {
                    part: {
                        **part_report(material, view.shown[i], self.traits),
                        "max_albedo": self.brdf(part).max_albedo(),
                        **self.plausibility(part),
                        "move": None if (moved := self.reached(part)) is None else str(moved),
                    }
                    for i, (part, material) in enumerate(
                        zip(view.scene.parts, materials, strict=True)
                    )
                },
                "painted": self._painted(view, transport),
                "history": self.history,
            }

    def _painted(self, view: View, transport: Transport) -> dict[str, float] | None:
        """Return the measured error of what is painted locally, and how many fragments that is."""
        local = view.local
        if local is None or not self.varying:
            return None
        some = [(view.scene.parts.index(part), one) for part, one in self.varying.items()]
        rng = np.random.default_rng(self.seed)
        error, count = local.error([one.frame for one in view.shown], some, rng, _MEASURED)
        return {"error": error, "fragments": count}

    # -- files ----------------------------------------------------------------------------------

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "EditSession: expected no copy or pickle of a session, which has threads and prepared "
            "light; session.save('design.tbr') and EditSession.load('design.tbr') carry a design"
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the design (present view and light, layers, own traits) to one file, atomically.

        The file holds only arrays and JSON. A loaded design renders the same frame: to the bit
        where parts are shown exactly or by the basis as prepared, within the error asked for where
        images were added to the basis. Undone changes are not kept.

        Parameters
        ----------
        path : path of the file, usually ``.tbr``

        Raises
        ------
        TypeError
            If the shape is neither a sphere nor a mesh.
        OSError
            If the file cannot be written.
        """
        with self._lock:
            scene, document = self.scene, self._document.copy()
        settings = {name: getattr(self.settings, name) for name in SETTINGS}
        write_design(path, scene, document, settings)

    def export(
        self,
        path: str | PathLike[str],
        texture_size: int = 1024,
        progress: Progress | None = None,
    ) -> Exported:
        """Write the design for another program; see `traitbrdf.export.files.export_design`.

        Parameters
        ----------
        path : path-like
            ``.glb`` (glTF 2.0), ``.mtlx`` (OpenPBR) or ``.py`` (a Mitsuba 3 scene).
        texture_size : int
            Texels on a side of the textures of parts that are painted locally.
        progress : called with (stage, fraction done); may raise to cancel
        """
        with self._lock:
            scene, document = self.scene, self._document.copy()
        return export_design(path, scene, document, self.embedding, texture_size, progress)

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> EditSession:
        """Read a design written by `save`.

        Designs of formats 1 and 2, older than layers, load as the materials that their edits led
        to. Designs of format 1, older than shadows, load without shadows and ground, one ray a
        pixel.

        Parameters
        ----------
        path : path of the file
        **settings
            Passed to `EditSession`, in place of those in the file.

        Raises
        ------
        FileNotFoundError
        traitbrdf.formats.files.FormatError
            If the file is damaged, or the design was made with another embedding, in which its
            coordinates mean other materials.
        """
        stored = Stored.read(path)
        with reading(path):
            Settings(**stored.settings)  # mistakes in the file are not the caller's
        given = dict(stored.settings)
        if stored.traits is not None:
            given["traits"] = stored.traits
        session = cls(stored.scene, **{**given, **settings})
        session._document = stored.document(session._document.palette)
        session._edited |= session.design.touched()
        return session
