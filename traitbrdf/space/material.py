"""A material of a part: coordinates, and what they leave out."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.reflectance.brdf import Reflectance, TabulatedBRDF
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.library import Library

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Material:
    """What one part is made of; equal if it is the same reflectance, of the same name.

    Attributes
    ----------
    z : (k,) coordinates
    mirror : (3,) weight of a perfect mirror beside the table
    offset : (cells, 3) or None, what an assigned table has in log f beyond the manifold
    table : (cells, 3) or None, an assigned table as it came, until it is edited
    name : what it was assigned from
    """

    z: Float64
    mirror: Float64
    offset: Float32 | None = None
    table: Float32 | None = None
    name: str = ""

    @classmethod
    def of_library(cls, name: str, library: Library) -> Material:
        """A member of a library by its name; ValueError on an unknown one."""
        z = library.coordinates[library.index(name)]
        return cls(library.embedding.clip(z), np.zeros(3), name=name)

    @classmethod
    def of_reflectance(cls, brdf: Reflectance, embedding: BRDFEmbedding) -> Material:
        """A table, a model or a measurement, as it comes and as the nearest coordinates."""
        grid = embedding.grid_
        name = str(getattr(brdf, "name", "")) or type(brdf).__name__
        table = (
            brdf.regrid(grid)
            if isinstance(brdf, TabulatedBRDF)
            else TabulatedBRDF.from_model(brdf, grid, name)
        )
        z = embedding.encode(table)
        values = np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)
        return cls(z, table.mirror, embedding.residual(table, z), values, name)

    @functools.cached_property
    def _key(self) -> tuple[object, ...]:
        # tables are large: one that was assigned anew is another
        return self.name, id(self.table), id(self.offset), self.z.tobytes(), self.mirror.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Material) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def energy_scale(self, embedding: BRDFEmbedding) -> float:
        """The factor by which it is lowered to reflect no more than all light."""
        if self.table is not None:  # shown as it came
            return 1.0
        return embedding.energy_scale(self.z, self.offset)

    def values(self, embedding: BRDFEmbedding, cells: Int64 | None = None) -> Float32:
        """f_r (n, 3) at `cells` (n,) of the embedding's grid; at all of them if left out."""
        if self.table is not None:
            whole = self.table
        elif cells is None or 2 * len(cells) > embedding.grid_.size:
            # the energy check reads most of the grid: of many cells, all come as fast
            whole = embedding.decode_values(self.z, self.offset)
        else:
            return embedding.decode_values(self.z, self.offset, cells)
        return whole if cells is None else whole.take(cells, axis=0)
