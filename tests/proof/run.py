"""All searches, printed as a table: ``make proof``."""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from tests.proof.promela import model_text
from tests.proof.searches import DEFAULT, LARGE, Wanted
from tests.proof.spin import HEADER, Pan, Search, compile_model, missing


class Bench:
    """Compiled models, each compiled once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._compiled: dict[tuple[int, bool], Pan] = {}

    def pan(self, parts: int, is_liveness: bool = False) -> Pan:
        """The verifier for so many parts."""
        key = parts, is_liveness
        if key not in self._compiled:
            folder = self._folder / f"{parts}{'-liveness' if is_liveness else ''}"
            self._compiled[key] = compile_model(model_text(parts), folder, is_liveness)
        return self._compiled[key]

    def search(self, wanted: Wanted, without: Sequence[int] = ()) -> Search:
        """One search."""
        name = f"{wanted.parts} parts: {wanted.name}"
        return self.pan(wanted.parts, wanted.is_liveness).search(name, wanted.parameters, without)


def is_as_wanted(wanted: Wanted, found: Search) -> bool:
    """It holds and was exhaustive, or broke the promise that it had to break."""
    return wanted.violates in found.error and bool(found.error) if wanted.violates else found.holds


def main(argv: Sequence[str] | None = None) -> int:
    """Print every search; 1 when one is not as wanted, 2 when spin or gcc is missing."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("word", nargs="?", default="", help="only searches whose name contains it")
    parser.add_argument("--stories", action="store_true", help="print each counterexample step by step")
    options = parser.parse_args(argv)
    if missing():
        print(missing(), file=sys.stderr)
        return 2
    wrong = 0
    print(HEADER)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for wanted in (w for w in (*DEFAULT, *LARGE) if options.word in w.name):
            found = bench.search(wanted)
            good = is_as_wanted(wanted, found)
            wrong += not good
            print(f"{found.row()}{'' if good else '  <-- NOT AS WANTED'}", flush=True)
            if found.story and options.stories:
                print(f"\n{found.story}\n")
    print("all as wanted" if not wrong else f"{wrong} NOT as wanted")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
