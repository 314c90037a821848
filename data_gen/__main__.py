"""``python -m data_gen``: rebuild the artifact that the package ships, from the recipe."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from data_gen.packing import COMPONENTS, COUNT, SEED, build
from traitbrdf.formats import write_arrays

_SHIPPED = Path(__file__).resolve().parent.parent / "traitbrdf" / "data" / "library.npz"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m data_gen", description=__doc__)
    parser.add_argument("--out", type=Path, default=_SHIPPED, help="file to write (%(default)s)")
    parser.add_argument("--count", type=int, default=COUNT, help="materials (%(default)s)")
    parser.add_argument("--seed", type=int, default=SEED, help="seed (%(default)s)")
    parser.add_argument(
        "--components", type=int, default=COMPONENTS, help="per colour channel (%(default)s)"
    )
    given = parser.parse_args(arguments)
    start = time.perf_counter()
    tty = sys.stderr.isatty()

    def progress(stage: str, fraction: float) -> None:
        if tty or fraction >= 1.0:
            end = "\n" if fraction >= 1.0 else "\r"
            print(f"{stage}: {100 * fraction:3.0f} %", end=end, file=sys.stderr, flush=True)

    try:
        if not given.out.parent.is_dir():  # rather than after the work
            raise FileNotFoundError(f"{given.out}: expected an existing folder")
        arrays = build(given.count, given.seed, given.components, progress)
        write_arrays(given.out, arrays)
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"data_gen: {error}", file=sys.stderr)
        return 1
    print(
        f"{given.out}: {len(arrays['names'])} materials, {3 * given.components} coordinates, "
        f"{given.out.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.1f} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
