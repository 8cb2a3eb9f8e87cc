"""Print the third-party requirements of some of our distributions, one per line.

``python deploy/dependencies.py [--dev] [--extra NAME] DISTRIBUTION...`` reads the pyproject.toml
files, so that the Makefile and the Dockerfile install exactly what each distribution declares.
``--locked REPORT`` prints the blocks of constraints.txt, hashes included, for the packages of a pip
resolution (``pip install --dry-run --report REPORT``): ``pip install --require-hashes`` then takes those alone.
``--locked-extra NAME`` does the same for the packages of one extra.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def declared(folder: Path) -> dict[str, Any]:
    """The pyproject.toml of one distribution."""
    with (folder / "pyproject.toml").open("rb") as stream:
        return tomllib.load(stream)


def requirements(services: list[str], extras: list[str], with_dev: bool) -> list[str]:
    """Third-party requirements of the shared package and of `services`, sorted."""
    shared = declared(ROOT)
    found = set(shared["project"]["dependencies"])
    for extra in extras:
        found |= set(shared["project"]["optional-dependencies"][extra])
    if with_dev:
        found |= set(shared["dependency-groups"]["dev"])
    for service in services:
        found |= set(declared(ROOT / "services" / service)["project"]["dependencies"])
    return sorted(name for name in found if not name.startswith("wearline"))


def plain(name: str) -> str:
    """The name under which the index knows a package."""
    return re.sub(r"[-_.]+", "-", re.split(r"[ \[<>=!~;(]", name, maxsplit=1)[0]).lower()


def locked(wanted: set[str]) -> list[str]:
    """The blocks of constraints.txt for some packages, in its order.

    Raises:
        SystemExit: one of them is not pinned there.
    """
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    blocks = {plain(block): block for block in re.split(r"\n(?=\S)", text.strip()) if "==" in block}
    if missing := sorted(wanted - blocks.keys()):
        sys.exit(f"constraints.txt: does not pin {', '.join(missing)}; pin anew with 'make constraints'")
    return [block for name, block in blocks.items() if name in wanted]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("services", nargs="*")
    parser.add_argument("--extra", action="append", default=[])
    parser.add_argument("--dev", action="store_true")
    parser.add_argument("--locked", type=Path, metavar="REPORT")
    parser.add_argument("--locked-extra", metavar="NAME")
    arguments = parser.parse_args()
    if arguments.locked is not None:
        resolved = json.loads(arguments.locked.read_text(encoding="utf-8"))["install"]
        sys.stdout.write("\n".join(locked({plain(entry["metadata"]["name"]) for entry in resolved})) + "\n")
        return
    if arguments.locked_extra is not None:
        extra = declared(ROOT)["project"]["optional-dependencies"][arguments.locked_extra]
        sys.stdout.write("\n".join(locked({plain(name) for name in extra})) + "\n")
        return
    sys.stdout.write("\n".join(requirements(arguments.services, arguments.extra, arguments.dev)) + "\n")


if __name__ == "__main__":
    main()
