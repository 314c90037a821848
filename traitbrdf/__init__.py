"""traitbrdf: paint traits, not parameters.

Materials of a shape's parts are edited by painting or moving traits ("shiny", "metallic") and
rendered at once under real light; what comes out is a real, tabulated BRDF.
"""

from typing import TYPE_CHECKING, Any

from traitbrdf import models as models
from traitbrdf import reference as reference
from traitbrdf.brdf import HalfDiffGrid as HalfDiffGrid
from traitbrdf.brdf import TabulatedBRDF as TabulatedBRDF
from traitbrdf.embedding import BRDFEmbedding as BRDFEmbedding
from traitbrdf.embedding import Library as Library
from traitbrdf.embedding import default_embedding as default_embedding
from traitbrdf.embedding import default_library as default_library
from traitbrdf.formats import FormatError as FormatError
from traitbrdf.lights import DirectionalLight as DirectionalLight
from traitbrdf.lights import EnvironmentMap as EnvironmentMap
from traitbrdf.lights import PointLight as PointLight
from traitbrdf.measured import MeasuredBRDF as MeasuredBRDF
from traitbrdf.scene import Camera as Camera
from traitbrdf.scene import Scene as Scene
from traitbrdf.shapes import load_mesh as load_mesh
from traitbrdf.shapes import sphere as sphere
from traitbrdf.shapes import teapot as teapot
from traitbrdf.strokes import Stroke as Stroke
from traitbrdf.studio import studio as studio
from traitbrdf.traits import Trait as Trait
from traitbrdf.traits import TraitSpace as TraitSpace
from traitbrdf.traits import default_traits as default_traits

if TYPE_CHECKING:
    from traitbrdf.editing import EditSession as EditSession

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
    "load_mesh",
    "models",
    "reference",
    "sphere",
    "studio",
    "teapot",
]


def __getattr__(name: str) -> Any:
    """Sessions are loaded when first asked for: torch and the compiled loops take a second, which
    materials and traits need not wait for."""
    if name == "EditSession":
        from traitbrdf.editing import EditSession

        globals()[name] = EditSession
        return EditSession
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
