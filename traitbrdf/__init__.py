"""Paint material traits on objects and see the result under real light at once.

Edit the materials of a shape's parts by painting or moving traits ("shiny", "metallic"). Each
result is a tabulated BRDF that can be written to a file.
"""

from typing import TYPE_CHECKING, Any

from traitbrdf import compiled as compiled  # first: it removes outdated compiled code
from traitbrdf import reference as reference
from traitbrdf.design import effects as effects
from traitbrdf.design.colours import Colour as Colour
from traitbrdf.design.colours import Highlight as Highlight
from traitbrdf.design.effects import *  # noqa: F403  (a new effect is public at once)
from traitbrdf.design.parameters import Parameters as Parameters
from traitbrdf.design.strokes import Stroke as Stroke
from traitbrdf.formats.files import FormatError as FormatError
from traitbrdf.reflectance import models as models
from traitbrdf.reflectance.brdf import HalfDiffGrid as HalfDiffGrid
from traitbrdf.reflectance.brdf import TabulatedBRDF as TabulatedBRDF
from traitbrdf.reflectance.measured import MeasuredBRDF as MeasuredBRDF
from traitbrdf.scene.camera import Camera as Camera
from traitbrdf.scene.lights import DirectionalLight as DirectionalLight
from traitbrdf.scene.lights import EnvironmentMap as EnvironmentMap
from traitbrdf.scene.lights import PointLight as PointLight
from traitbrdf.scene.meshes import load_mesh as load_mesh
from traitbrdf.scene.scene import Scene as Scene
from traitbrdf.scene.shapes import sphere as sphere
from traitbrdf.scene.teapot import teapot as teapot
from traitbrdf.space.embedding import BRDFEmbedding as BRDFEmbedding
from traitbrdf.space.learning import Trait as Trait
from traitbrdf.space.library import Library as Library
from traitbrdf.space.library import default_embedding as default_embedding
from traitbrdf.space.library import default_library as default_library
from traitbrdf.space.search import find_materials as find_materials
from traitbrdf.space.traits import TraitSpace as TraitSpace
from traitbrdf.space.traits import default_traits as default_traits
from traitbrdf.studio import studio as studio

if TYPE_CHECKING:
    from traitbrdf.session.editing import EditSession as EditSession

__version__ = "0.1.0"

__all__ = [
    "BRDFEmbedding",
    "Camera",
    "DirectionalLight",
    "EditSession",
    "EnvironmentMap",
    "FormatError",
    "HalfDiffGrid",
    "Library",
    "MeasuredBRDF",
    "PointLight",
    "Scene",
    "Stroke",
    "TabulatedBRDF",
    "Trait",
    "TraitSpace",
    "default_embedding",
    "default_library",
    "default_traits",
    "find_materials",
    "load_mesh",
    "models",
    "reference",
    "sphere",
    "studio",
    "teapot",
]
__all__ += [*effects.__all__, "Colour", "Highlight", "Parameters"]


def __getattr__(name: str) -> Any:
    """Import sessions on first use: torch and the compiled loops take a second to load."""
    if name == "EditSession":
        from traitbrdf.session.editing import EditSession

        globals()[name] = EditSession
        return EditSession
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
