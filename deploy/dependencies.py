"""Print the third-party requirements of some of our distributions, one per line.

``python deploy/dependencies.py [--dev] [--extra NAME] DISTRIBUTION...`` reads the pyproject.toml
files, so that the Makefile and the Dockerfile install exactly what each distribution declares.
``pip install -c constraints.txt`` then pins and checks the hash of every one of them.
"""

from __future__ import annotations

import argparse
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("services", nargs="*")
    parser.add_argument("--extra", action="append", default=[])
    parser.add_argument("--dev", action="store_true")
    arguments = parser.parse_args()
    sys.stdout.write("\n".join(requirements(arguments.services, arguments.extra, arguments.dev)) + "\n")


if __name__ == "__main__":
    main()
