"""Tables of a recipe's members: made in pieces, kept on disk, and made only once.

A piece is a file of 60 members' tables. This process, or workers of a Dask cluster that see the
same folder, make each from its range of members alone, since every member is drawn from the seed
independently. Interrupted work is resumed, and the same seed gives the same files wherever they are
made.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import atomic_path
from traitbrdf.recipes import anchors, families, looks, spectra
from traitbrdf.recipes import materials as recipe
from traitbrdf.recipes.looks import Material
from traitbrdf.recipes.materials import materials
from traitbrdf.reflectance import brdf, models
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF

PIECE = 60
"""Members of a piece: 14 MB on the grid of the library."""

Progress = Callable[[str, float], None]


def table_of(material: Material, grid: HalfDiffGrid) -> TabulatedBRDF:
    """Tabulate a member, with albedo 1 at most.

    Parameters
    ----------
    material : Material
    grid : HalfDiffGrid
    """
    table = TabulatedBRDF.from_model(material.model, grid, material.name)
    # interpolating a sharp lobe can add a percent of energy that its closed form has not
    excess = table.max_albedo()
    if excess > 1.0:
        table = TabulatedBRDF(grid, table.values / np.float32(excess), name=material.name)
    return table


def write_piece(path: str, seed: int, start: int, stop: int, grid: HalfDiffGrid) -> str:
    """Write the tables (stop - start, *grid.shape, 3) float32 of some members.

    Parameters
    ----------
    path : str
    seed : int
    start, stop : int
        The range of members.
    grid : HalfDiffGrid

    Returns
    -------
    str
        The path.
    """
    values = [table_of(material, grid).values for material in materials(seed, stop, start)]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, np.stack(values).astype(np.float32))
    return path


class Tables:
    """The tables of the first members of a recipe; they can be iterated over repeatedly.

    Parameters
    ----------
    folder : Path
        Where the pieces are; it is made if it does not exist.
    count, seed : int
        As for `traitbrdf.recipes.materials.materials`.
    grid : HalfDiffGrid
    """

    def __init__(self, folder: Path, count: int, seed: int, grid: HalfDiffGrid) -> None:
        known = list(materials(seed, count))  # bad numbers end here
        self.names, self.families = [m.name for m in known], [m.family for m in known]
        self.count, self.seed, self.grid = count, seed, grid
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._key = _key(seed, grid)

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[TabulatedBRDF]:
        for start, stop in self._ranges():
            values: NDArray[np.float32] = np.load(self._path(start, stop), mmap_mode="r")
            for name, table in zip(self.names[start:stop], values, strict=True):
                yield TabulatedBRDF(self.grid, np.array(table), name=name)

    def _ranges(self) -> list[tuple[int, int]]:
        starts = range(0, self.count, PIECE)
        return [(start, min(start + PIECE, self.count)) for start in starts]

    def _path(self, start: int, stop: int) -> Path:
        return self.folder / f"{self._key}-{start:07d}-{stop:07d}.npy"

    def missing(self) -> list[tuple[int, int]]:
        """Return ranges whose pieces are still to be made."""
        return [pair for pair in self._ranges() if not self._path(*pair).is_file()]

    def make(self, workers: int | str = 0, progress: Progress | None = None) -> None:
        """Make the pieces that are missing.

        Parameters
        ----------
        workers : int or str
            0 makes them in this process; a positive number starts a local Dask cluster of so many
            processes (the extra ``dask``). Text is the address of a running scheduler, whose
            workers see the folder.
        progress : callable, optional
            Called with (stage, fraction). It may raise to stop; finished pieces stay.

        Raises
        ------
        ModuleNotFoundError
            If there are workers, but no Dask.
        """
        report = progress or (lambda stage, fraction: None)
        pairs = self.missing()
        whole = len(self._ranges())
        calls = [(str(self._path(*pair)), self.seed, *pair, self.grid) for pair in pairs]
        with ExitStack() as stack:
            made: Iterator[object] = (write_piece(*call) for call in calls)
            if workers and calls:
                from distributed import Client, as_completed  # an optional extra

                local = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
                given = {"address": workers} if isinstance(workers, str) else local
                client = stack.enter_context(Client(**given))  # type: ignore[no-untyped-call]
                futures = [client.submit(write_piece, *call, pure=False) for call in calls]
                done = as_completed(futures)  # type: ignore[no-untyped-call]
                made = (future.result() for future in done)
            report("tabulating", 1.0 - len(calls) / max(whole, 1))
            for count, _ in enumerate(made, whole - len(calls) + 1):
                report("tabulating", count / whole)

    def remove(self) -> None:
        """Delete the pieces, and the folder if nothing else is in it."""
        for pair in self._ranges():
            self._path(*pair).unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()


def _key(seed: int, grid: HalfDiffGrid) -> str:
    """Return a digest of all that tables depend on: other recipes or models make other files."""
    digest = hashlib.sha256(repr((seed, grid)).encode())
    for module in (looks, families, anchors, recipe, spectra, models, brdf):
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:12]
