"""The material of one part: its coordinates, and what these leave out."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from traitbrdf.host import steady
from traitbrdf.reflectance.brdf import Reflectance, TabulatedBRDF
from traitbrdf.reflectance.models import Model
from traitbrdf.reflectance.parameters import is_closed_form
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.library import Library
from traitbrdf.space.logmap import log_map

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@steady
@dataclass(frozen=True, eq=False)
class Material:
    """The material of one part; two are equal if reflectance and name are the same.

    Attributes
    ----------
    z : (k,) float64
        Coordinates in the embedding.
    mirror : (3,) float64
        Weight of a perfect mirror that is added to the table, for each channel.
    offset : (cells, 3) float32 or None
        What an assigned table has in log(f + FLOOR) beyond the table decoded at `z`.
    table : (cells, 3) float32 or None
        f in 1/sr of an assigned table, unchanged; None once the material has been edited.
    name : str
        The library member, file or model that it was assigned from.
    model : Model or None
        The closed form that `table` samples; None once anything but its parameters was edited.
    """

    z: Float64
    mirror: Float64
    offset: Float32 | None = None
    table: Float32 | None = None
    name: str = ""
    model: Model | None = None

    @classmethod
    def of_library(cls, name: str, library: Library) -> Material:
        """Make the material of a library member.

        Parameters
        ----------
        name : str
        library : Library

        Raises
        ------
        ValueError
            On an unknown name.
        """
        z = library.coordinates[library.index(name)]
        return cls(library.embedding.clip(z), np.zeros(3), name=name)

    @classmethod
    def of_reflectance(cls, brdf: Reflectance, embedding: BRDFEmbedding) -> Material:
        """Make a material of a table, a model or a measurement.

        It is shown unchanged until it is edited; edits start at its nearest coordinates.

        Parameters
        ----------
        brdf : Reflectance
        embedding : BRDFEmbedding

        Raises
        ------
        TypeError
            On something that has no ``eval``.
        """
        grid = embedding.grid_
        name = str(getattr(brdf, "name", "")) or type(brdf).__name__
        table = (
            brdf.regrid(grid)
            if isinstance(brdf, TabulatedBRDF)
            else TabulatedBRDF.from_model(brdf, grid, name)
        )
        z = embedding.encode(table)
        values = np.ascontiguousarray(table.values.reshape(-1, 3), np.float32)
        model = brdf if isinstance(brdf, Model) and is_closed_form(brdf) else None
        return cls(z, table.mirror, embedding.residual(table, z), values, name, model)

    @functools.cached_property
    def _key(self) -> tuple[object, ...]:
        # tables are large, so they are compared by identity
        arrays = id(self.table), id(self.offset), self.z.tobytes(), self.mirror.tobytes()
        return self.name, self.model, *arrays

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Material) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def energy_scale(self, embedding: BRDFEmbedding) -> float:
        """Return the factor in (0, 1] by which the shown material is darkened to conserve energy.

        Parameters
        ----------
        embedding : BRDFEmbedding
        """
        if self.table is not None:  # shown unchanged
            return 1.0
        return embedding.energy_scale(self.z, self.offset)

    def least_squares(self, embedding: BRDFEmbedding) -> Float64:
        """Return the coordinates (k,) that fit the material's table by least squares.

        They are found once. See `BRDFEmbedding.least_squares`.

        Parameters
        ----------
        embedding : BRDFEmbedding
        """
        known: tuple[BRDFEmbedding, Float64] | None = self.__dict__.get("_fitted")
        if known is None or known[0] is not embedding:
            logs = np.ascontiguousarray(log_map(self.values(embedding)).T)[None]
            known = embedding, embedding.least_squares(logs)[0]
            self.__dict__["_fitted"] = known
        return known[1]

    def as_table(self, embedding: BRDFEmbedding, name: str = "") -> TabulatedBRDF:
        """Return the material as a table on the embedding's grid.

        Parameters
        ----------
        embedding : BRDFEmbedding
        name : str
            Of the table, if the material has none.
        """
        grid = embedding.grid_
        values = self.values(embedding).reshape(*grid.shape, 3)
        return TabulatedBRDF(grid, values, self.mirror, self.name or name)

    def values(self, embedding: BRDFEmbedding, cells: Int64 | None = None) -> Float32:
        """Return f_r in 1/sr at cells of the embedding's grid.

        Parameters
        ----------
        embedding : BRDFEmbedding
        cells : (n,) int64, optional
            Flat indices of cells; all of them if left out.

        Returns
        -------
        (n, 3) float32
        """
        if self.table is not None:
            whole = self.table
        elif cells is None or 2 * len(cells) > embedding.grid_.size:
            # the energy check reads most of the grid, so decoding all of it takes no longer
            whole = embedding.decode_values(self.z, self.offset)
        else:
            return embedding.decode_values(self.z, self.offset, cells)
        return whole if cells is None else whole.take(cells, axis=0)
