"""``wearline backup`` and ``wearline restore``."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from wearline.cli import Command
from wearline.config import CellSettings, load_cell, validated
from wearline.errors import UsageError
from wearline_judge.config import JudgeSettings
from wearline_judge.drivers.backup import SERVICES, count_rows, opened, restore, write_backup
from wearline_judge.drivers.lock import FolderLock
from wearline_judge.drivers.records import open_engine, sqlite_url
from wearline_judge.service import open_records


def _configure_backup(parser: ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")
    parser.add_argument("--out", type=Path, required=True, metavar="BACKUP.tar", help=".tar.gz or .tgz packs it")


def _run_backup(arguments: Namespace) -> int:
    cell = load_cell(arguments.config)
    settings = validated(JudgeSettings, cell.judge, f"{arguments.config}: judge")
    out: Path = arguments.out
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError("is a folder" if out.is_dir() else "lies in no folder", f"--out {out}", "name a file to write")
    open_records(cell, settings, must_exist=True).close()
    url = _url(cell, settings)
    utc = datetime.now(UTC).isoformat(timespec="seconds")
    engine = open_engine(url)
    try:
        told = _teller("backup", count_rows(engine))
    finally:
        engine.dispose()
    manifest = write_backup(out, cell.cell, utc, cell.data_dir, url, told)
    _end()
    print(f"{out}: {len(manifest.files)} files, {manifest.entries} entries of the chain, checked after writing")
    return 0


def _configure_restore(parser: ArgumentParser) -> None:
    parser.add_argument("backup", type=Path, metavar="BACKUP.tar")
    parser.add_argument("--config", type=Path, required=True, metavar="CELL.yaml")


def _run_restore(arguments: Namespace) -> int:
    cell = load_cell(arguments.config)
    settings = validated(JudgeSettings, cell.judge, f"{arguments.config}: judge")
    with opened(arguments.backup) as (staged, manifest):
        if manifest.cell != cell.cell:
            raise UsageError(
                f"is of cell {manifest.cell}, not {cell.cell}", str(arguments.backup), "name the right cell"
            )
        aside = _set_aside(cell)
        restore(staged, cell.data_dir, settings.records_url, _teller("restore", manifest.entries))
    _end()
    print(f"{cell.data_dir}: restored from {arguments.backup} of {manifest.utc}, {manifest.entries} entries")
    if aside:
        print(f"  what was there before is in {aside}")
    return 0


def _set_aside(cell: CellSettings) -> Path | None:
    """Move what is there out of the way; frames stay, they are named by their content.

    Raises:
        RecordError: the judge is running.
    """
    folder = cell.data_folder("judge")
    lock = FolderLock(folder)
    try:
        stamp = f"before-restore-{datetime.now(UTC):%Y%m%dT%H%M%S%f}"
        aside = cell.data_dir / stamp
        for path in (cell.data_dir / service for service in SERVICES):
            if not path.is_dir():
                continue
            for kept in sorted(path.iterdir()) if path == folder else (path,):
                if path == folder and kept.name in ("frames", "lock", "reserve"):
                    continue
                target = aside / kept.relative_to(cell.data_dir)
                target.parent.mkdir(parents=True, exist_ok=True)
                kept.rename(target)
        return aside if aside.exists() else None
    finally:
        lock.close()


def _url(cell: CellSettings, settings: JudgeSettings) -> str:
    return settings.records_url or sqlite_url(cell.data_folder("judge") / "records.db")


def _teller(label: str, total: int) -> Callable[[int], None]:
    """Draws how many rows are done, on a terminal."""
    done = 0

    def tell(rows: int) -> None:
        nonlocal done
        done += rows
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{label} {done} of {total} rows")
            sys.stderr.flush()

    return tell


def _end() -> None:
    if sys.stderr.isatty():
        with suppress(OSError):
            sys.stderr.write("\n")


BACKUP = Command(
    "backup", "an archive of a cell's durable data, while it runs, checked", _configure_backup, _run_backup
)
RESTORE = Command("restore", "put a backup back", _configure_restore, _run_restore)
