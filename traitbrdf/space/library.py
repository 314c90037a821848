"""The library that the package ships: names, coordinates, and what members were made from."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from traitbrdf.formats.files import artifact, unknown_name
from traitbrdf.host import steady
from traitbrdf.reflectance.brdf import SUFFIXES, TabulatedBRDF, how_to_read
from traitbrdf.space.embedding import BRDFEmbedding


@steady
class Library:
    """Named materials as points of an embedding.

    Parameters
    ----------
    embedding : BRDFEmbedding
    names : n str
    coordinates : (n, k) array_like
    families : n str
        The kind of material that each member is.
    parameters : n mappings, optional
        What the recipe of a member's family was given, by name: numbers, and colours as lists of
        three; empty where unknown. Together with the recipe's seed they make the member again.
    descriptors : mapping of (n,) array_like, optional
        Physical descriptors of each member's own table, by name
        (`traitbrdf.reflectance.descriptors`).

    Attributes
    ----------
    embedding : BRDFEmbedding
    names, families : tuples of str
    coordinates : (n, k) float64
    parameters : tuple of mappings
    descriptors : dict of (n,) float64

    Raises
    ------
    ValueError
        If the numbers of names, coordinates, parameters and descriptors differ.
    """

    def __init__(
        self,
        embedding: BRDFEmbedding,
        names: Sequence[str],
        coordinates: ArrayLike,
        families: Sequence[str],
        parameters: Sequence[Mapping[str, Any]] | None = None,
        descriptors: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        self.embedding = embedding
        self.names = tuple(names)
        self.families = tuple(families)
        self.coordinates = np.asarray(coordinates, np.float64)
        if self.coordinates.shape != (len(self.names), embedding.size):
            raise ValueError(
                f"coordinates: expected shape {(len(self.names), embedding.size)}, "
                f"got {self.coordinates.shape}"
            )
        self.parameters = tuple(parameters) if parameters is not None else ({},) * len(self.names)
        if len(self.parameters) != len(self.names):
            raise ValueError(
                f"parameters: expected {len(self.names)} of them, got {len(self.parameters)}"
            )
        self.descriptors = {k: np.asarray(v, np.float64) for k, v in (descriptors or {}).items()}
        for name, column in self.descriptors.items():
            if column.shape != (len(self.names),):
                raise ValueError(
                    f"descriptors: expected ({len(self.names)},) values of {name!r}, "
                    f"got shape {column.shape}"
                )
        self._index = {name: i for i, name in enumerate(self.names)}

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self._index

    def __repr__(self) -> str:
        return f"Library({len(self)} materials of {len(set(self.families))} families)"

    def __getitem__(self, name: str) -> TabulatedBRDF:
        """Decode the table of a material."""
        table = self.embedding.decode(self.coordinates[self.index(name)])
        table.name = name
        return table

    def index(self, name: str) -> int:
        """Return where a material stands in `names`.

        Parameters
        ----------
        name : str

        Raises
        ------
        ValueError
            If there is no such material; the message names the nearest ones.
        """
        if name not in self._index:
            if isinstance(name, str) and Path(name).suffix.lower() in SUFFIXES:
                raise ValueError(f"material: {name!r} is no library material: {how_to_read(name)}")
            raise ValueError(unknown_name("material", name, self.names))
        return self._index[name]


@steady
@functools.lru_cache(maxsize=1)
def default_embedding() -> BRDFEmbedding:
    """Load the embedding that the package ships, once."""
    return BRDFEmbedding.from_arrays(artifact())


@steady
@functools.lru_cache(maxsize=1)
def default_library() -> Library:
    """Load the named materials that the package ships, once.

    Their coordinates are points of `default_embedding`.
    """
    state = artifact()
    return Library(
        default_embedding(),
        [str(n) for n in state["names"]],
        state["coordinates"],
        [str(f) for f in state["families"]],
        [json.loads(str(text)) for text in state["parameters"]],
        dict(zip(state["descriptor_names"].tolist(), state["descriptors"].T, strict=True)),
    )
