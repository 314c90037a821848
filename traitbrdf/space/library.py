"""The library that the package ships: names, coordinates, and what members were made from."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from traitbrdf.formats.files import artifact, unknown_name
from traitbrdf.reflectance.brdf import (
    TabulatedBRDF,
)

if TYPE_CHECKING:  # where it is needed it is imported: it takes a second
    pass
from traitbrdf.space.embedding import BRDFEmbedding


class Library:
    """Named materials as points of an embedding.

    Attributes
    ----------
    names, families : tuples of str
    coordinates : (n, k) float64
    parameters : tuple of mappings
        What the recipe of a member's family was given, by name: numbers, and colours as lists of
        three; empty where unknown. With the recipe's seed they are what `data_gen` draws.
    descriptors : dict of (n,) float64
        Physical descriptors of each member's own table, by name
        (`traitbrdf.reflectance.descriptors`).
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
        """The decoded table of a material."""
        table = self.embedding.decode(self.coordinates[self.index(name)])
        table.name = name
        return table

    def index(self, name: str) -> int:
        """Where `name` stands in `names`.

        Raises
        ------
        ValueError
            If there is no such material; the message names the nearest ones.
        """
        if name not in self._index:
            raise ValueError(unknown_name("material", name, self.names))
        return self._index[name]


@functools.lru_cache(maxsize=1)
def default_embedding() -> BRDFEmbedding:
    """The embedding that the package ships."""
    return BRDFEmbedding.from_arrays(artifact())


@functools.lru_cache(maxsize=1)
def default_library() -> Library:
    """The named materials that the package ships, as points of `default_embedding`."""
    state = artifact()
    return Library(
        default_embedding(),
        [str(n) for n in state["names"]],
        state["coordinates"],
        [str(f) for f in state["families"]],
        [json.loads(str(text)) for text in state["parameters"]],
        dict(zip(state["descriptor_names"].tolist(), state["descriptors"].T, strict=True)),
    )
