"""Run ``python -m data_gen``: rebuild the shipped artifact, or study embeddings and traits."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from data_gen.packing import COMPONENTS, COUNT, SEED, build
from data_gen.study import CANDIDATES, study, table, trait_table
from data_gen.tables import Tables
from traitbrdf.formats.files import write_arrays
from traitbrdf.space.embedding import GRID

_SHIPPED = Path(__file__).resolve().parent.parent / "traitbrdf" / "data" / "library.npz"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, and return its exit status.

    Parameters
    ----------
    arguments : list of str, optional
        Left out, they are the process's own.
    """
    parser = argparse.ArgumentParser(
        prog="python -m data_gen",
        description="Rebuild the artifact that the package ships, or study embeddings and traits.",
    )
    parser.add_argument(
        "what", nargs="?", choices=("build", "study", "traits"), default="build",
        help="build the artifact, compare embeddings on measured materials, or tell of the traits "
        "(%(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"),
        help="for study: folder of measured materials; held-out members alone without it",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=_SHIPPED, help="file to write (%(default)s)")
    parser.add_argument("--count", type=int, default=COUNT, help="materials (%(default)s)")
    parser.add_argument("--seed", type=int, default=SEED, help="seed (%(default)s)")
    parser.add_argument(
        "--components",
        type=int,
        nargs=2,
        default=COMPONENTS,
        metavar=("GREY", "COLOUR"),
        help="of the channels' mean, and of each of two colour axes (%(default)s)",
    )
    parser.add_argument(
        "--tables", type=Path, default=Path("out/tables"), metavar="DIR",
        help="where tables are kept meanwhile, 0.24 MB a material; the same command goes on there "
        "after an interruption (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--keep", action="store_true", help="do not delete them in the end")
    parser.add_argument(
        "--workers", type=lambda text: int(text) if text.isdigit() else text, default=0,
        help="processes of a local Dask cluster that make them, or a scheduler's address whose "
        "workers see the folder; 0: this process (%(default)s)",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    start = time.perf_counter()
    tty = sys.stderr.isatty()

    def progress(stage: str, fraction: float) -> None:
        if tty or fraction >= 1.0:
            end = "\n" if fraction >= 1.0 else "\r"
            print(f"{stage}: {100 * fraction:3.0f} %", end=end, file=sys.stderr, flush=True)

    if given.what == "traits":
        print(trait_table())
        return 0
    if given.what == "study":
        data = given.data if (given.data / "merl_slices").is_dir() else None
        try:
            print(table(list(study(CANDIDATES, given.count, data, given.seed, progress))))
        except KeyboardInterrupt:
            return 1
        except ValueError as error:
            print(f"data_gen: {error}", file=sys.stderr)
            return 1
        return 0
    try:
        if not given.out.parent.is_dir():  # rather than after the work
            raise FileNotFoundError(f"{given.out}: expected an existing folder")
        arrays = build(
            given.count, given.seed, tuple(given.components), progress, given.tables, given.workers
        )
        write_arrays(given.out, arrays)
        if not given.keep:
            Tables(given.tables, given.count, given.seed, GRID).remove()
    except KeyboardInterrupt:
        print(
            f"interrupted; {given.out} is as it was, and what was tabulated waits in "
            f"{given.tables} for the same command",
            file=sys.stderr,
        )
        return 1
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"data_gen: {error}", file=sys.stderr)
        return 1
    count, coordinates = arrays["coordinates"].shape
    print(
        f"{given.out}: {count} materials, {coordinates} coordinates, "
        f"{given.out.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.1f} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
