"""``wearline recipe``: the object list of a cell, whether or not the cell runs."""

from __future__ import annotations

import getpass
import sys
from argparse import ArgumentParser, Namespace
from datetime import UTC, datetime
from pathlib import Path

from wearline.cli import Command
from wearline.config import load_cell
from wearline.errors import UsageError
from wearline.recipe import dump_recipe
from wearline_judge.commands.files import load_references
from wearline_judge.drivers.blobs import BlobStore
from wearline_judge.drivers.objects import Listed, ObjectFile, Version


def _configure(parser: ArgumentParser) -> None:
    parser.add_argument("action", choices=("list", "add", "release", "rollback", "show"))
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--object", type=int, metavar="N", help="object index, as the PLC selects it (0-65535)")
    parser.add_argument("--name", help="of the object; add only")
    parser.add_argument("--recipe", type=Path, metavar="R.yaml", help="add only; default settings without it")
    parser.add_argument("--calibration", type=Path, metavar="C.npz", help="add only")
    parser.add_argument(
        "--template", type=Path, metavar="T.npz", help="add only; without it the object is to be taught"
    )
    parser.add_argument("--draft", action="store_true", help="add only: do not release it")
    parser.add_argument("--version", type=int, metavar="V", help="release and show only")
    parser.add_argument("--note", default="", help="add only: why")


def _run(arguments: Namespace) -> int:
    folder = load_cell(arguments.config).data_folder("judge")
    objects, blobs = ObjectFile(folder / "objects.json"), BlobStore(folder)
    if arguments.action == "list":
        return _list(objects)
    index: int | None = arguments.object
    if index is None:
        raise UsageError("is missing", "--object", "name the object index that the PLC selects")
    if not 0 <= index <= 65535:
        raise UsageError(f"{index} is no object index", "--object", "give 0 to 65535")
    if arguments.action == "add":
        return _add(arguments, index, objects, blobs)
    if arguments.action == "release":
        if arguments.version is None:
            raise UsageError("is missing", "--version", "see 'wearline recipe show'")
        _say(index, objects.release(index, arguments.version), "is released")
    elif arguments.action == "rollback":
        _say(index, objects.rollback(index), "is released again")
    else:
        return _show(arguments, index, objects, blobs)
    return 0


def _say(index: int, version: Version, what: str) -> None:
    print(f"object {index}: version {version.version} {what}")


def _list(objects: ObjectFile) -> int:
    listed = objects.objects()
    if not listed:
        print("no objects; add one with 'wearline recipe add'")
        return 0
    print(
        f"{'object':>6}  {'name':<20} {'released':>8}  {'versions':>8}  {'recipe':<12}  {'calibration':<12}  template"
    )
    for index, entry in sorted(listed.items()):
        ruling = entry.ruling
        hashes = ("", "", "") if ruling is None else (
            ruling.recipe_hash[:12], ruling.calibration_hash[:12], ruling.template_hash[:12] or "(to be taught)"
        )  # fmt: skip
        released = "none" if ruling is None else str(ruling.version)
        print(
            f"{index:>6}  {entry.name:<20} {released:>8}  {len(entry.versions):>8}  {hashes[0]:<12}  {hashes[1]:<12}"
            f"  {hashes[2]}"
        )
    return 0


def _add(arguments: Namespace, index: int, objects: ObjectFile, blobs: BlobStore) -> int:
    known = objects.objects().get(index)
    name: str = arguments.name or (known.name if known else "")
    if not name:
        raise UsageError("is missing", "--name", "name the object as people know it")
    references = load_references(arguments.calibration, arguments.template, arguments.recipe)
    version = objects.add(
        index, name, blobs.put_recipe(references.recipe), blobs.put_artifact(references.calibration_bytes),
        blobs.put_artifact(references.template_bytes) if references.template_bytes else "",
        datetime.now(UTC).isoformat(timespec="seconds"), _person(), arguments.note, release=not arguments.draft,
    )  # fmt: skip
    _say(index, version, "is a draft" if arguments.draft else "is released")
    return 0


def _person() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        # A container's user need not have a name.
        return ""


def _show(arguments: Namespace, index: int, objects: ObjectFile, blobs: BlobStore) -> int:
    listed = objects.objects().get(index)
    if listed is None:
        raise UsageError("is not in the object list", f"object {index}", "see 'wearline recipe list'")
    wanted = _wanted(listed, index, arguments.version)
    for version in listed.versions:
        mark = "*" if version == listed.ruling else " "
        said = f" by {version.person}" if version.person else ""
        print(f"# {mark} version {version.version}, {version.utc}{said}{': ' if version.note else ''}{version.note}")
    print(f"# object {index}, {listed.name}, version {wanted.version}")
    print(f"# calibration {wanted.calibration_hash}")
    print(f"# template {wanted.template_hash or '(to be taught)'}")
    print(f"# recipe {wanted.recipe_hash}")
    sys.stdout.write(dump_recipe(blobs.recipe(wanted.recipe_hash)))
    return 0


def _wanted(listed: Listed, index: int, version: int | None) -> Version:
    if version is None:
        return listed.ruling or listed.versions[-1]
    for found in listed.versions:
        if found.version == version:
            return found
    raise UsageError(f"has no version {version}", f"object {index}", "see 'wearline recipe show'")


RECIPE = Command("recipe", "the object list of a cell: list, add, release, rollback, show", _configure, _run)
