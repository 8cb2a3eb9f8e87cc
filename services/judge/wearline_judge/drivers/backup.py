"""One archive of a cell's durable data, written while the cell runs, and checked to the last entry.

Tables are copied in one snapshot into a SQLite file of the archive, wherever they came from, and
back into SQLite or PostgreSQL; other files are copied as they are.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Engine, func, insert, select
from sqlalchemy.exc import SQLAlchemyError

from wearline.errors import RecordError
from wearline_judge.drivers.chain import ChainError, key_of
from wearline_judge.drivers.records import RecordStore, open_engine, sqlite_url
from wearline_judge.drivers.schema import migrate, version_of
from wearline_judge.drivers.tables import METADATA

FORMAT = "wearline.backup.v1"
_MANIFEST = "manifest.json"
_RECORDS = "judge/records.db"
_SQLITE = b"SQLite format 3\0"
SERVICES = ("fieldbus", "hmi", "judge")
"""Whose folders hold what cannot be made again."""
_LEFT_OUT = ("-wal", "-shm", ".lock")
_AT_ONCE = 2000


@dataclass(frozen=True)
class Manifest:
    """What an archive holds."""

    cell: str
    utc: str
    entries: int
    files: dict[str, str]
    """Name in the archive -> sha256."""


def copy_tables(source: Engine, target: Engine, done: Callable[[int], object] = lambda _: None) -> None:
    """Copy all tables of one snapshot into an empty database.

    Raises:
        SQLAlchemyError: of either side.
    """
    options = {"is_reading": True}
    if source.dialect.name == "postgresql":
        options |= {"isolation_level": "REPEATABLE READ"}  # type: ignore[dict-item]
    with source.connect().execution_options(**options) as old, target.begin() as new:
        migrate(new, version_of(old))
        for table in METADATA.sorted_tables:
            found = old.execution_options(stream_results=True, yield_per=_AT_ONCE).execute(select(table))
            for rows in found.mappings().partitions(_AT_ONCE):
                new.execute(insert(table), [dict(row) for row in rows])
                done(len(rows))


def count_rows(source: Engine) -> int:
    """Rows of all tables."""
    with source.connect().execution_options(is_reading=True) as db:
        return sum(int(db.execute(select(func.count()).select_from(t)).scalar() or 0) for t in METADATA.sorted_tables)


def write_backup(
    out: Path, cell: str, utc: str, data_dir: Path, records_url: str, done: Callable[[int], object] = lambda _: None
) -> Manifest:
    """Write an archive, read it again and check it; it appears under its name only when it is sound.

    Raises:
        RecordError: something cannot be read or written, or what was written is not sound.
    """
    draft = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".backup-") as work:
            staged = Path(work)
            _stage(staged, data_dir)
            engine = open_engine(records_url)
            target = open_engine(sqlite_url(staged / _RECORDS))
            try:
                copy_tables(engine, target, done)
            finally:
                engine.dispose()
                target.dispose()
            with closing(sqlite3.connect(staged / _RECORDS)) as db:
                entries = int(db.execute("SELECT count(*) FROM entry").fetchone()[0])
                # One file, without a log beside it.
                db.execute("PRAGMA journal_mode=DELETE")
            files = {str(p.relative_to(staged)): _sha256(p) for p in sorted(staged.rglob("*")) if p.is_file()}
            manifest = Manifest(cell, utc, entries, files)
            (staged / _MANIFEST).write_text(json.dumps({"format": FORMAT, **manifest.__dict__}, indent=1))
            # It holds the key of the chain and the users' password hashes.
            file = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(file, "wb") as stream:
                with tarfile.open(fileobj=stream, mode="w:gz" if out.suffix in (".gz", ".tgz") else "w") as archive:
                    archive.add(staged / _MANIFEST, _MANIFEST)
                    for name in files:
                        archive.add(staged / name, name)
                stream.flush()
                os.fsync(stream.fileno())
        with opened(draft) as (_, found):
            if found != manifest:
                raise RecordError("was not written as it should be", str(out), "check the disk")
        draft.replace(out)
    except (OSError, SQLAlchemyError, sqlite3.Error, tarfile.TarError) as error:
        raise RecordError(
            f"cannot be written ({str(error).splitlines()[0]})", str(out), "check path and free space"
        ) from error
    finally:
        draft.unlink(missing_ok=True)
    return manifest


def _stage(staged: Path, data_dir: Path) -> None:
    """Copy the files of `SERVICES`, but for frames and the judge's own database."""
    (staged / "judge").mkdir(parents=True)
    for path in sorted(data_dir.rglob("*")):
        name = path.relative_to(data_dir)
        is_judge = name.parts[0] == "judge"
        if not path.is_file() or path.is_symlink() or path.name.endswith(_LEFT_OUT) or path.name.startswith("."):
            continue
        if name.parts[0] not in SERVICES or (is_judge and name.parts[1] in ("frames", "reserve", "lock")):
            continue
        if is_judge and name.parts[1].startswith("records.db"):
            continue
        target = staged / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with path.open("rb") as file:
            is_sqlite = file.read(16) == _SQLITE
        if is_sqlite:
            with (
                closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as old,
                closing(sqlite3.connect(target)) as new,
            ):
                old.backup(new)
        else:
            target.write_bytes(path.read_bytes())
        target.chmod(path.stat().st_mode & 0o777)


def _entries(staged: Path) -> int:
    """Check the chain of the copied records; returns how many entries there are.

    Raises:
        RecordError: one was altered.
    """
    records = RecordStore(sqlite_url(staged / _RECORDS), key_of(staged / "judge" / "chain.key"), must_exist=True)
    try:
        return sum(1 for _ in records.verified())
    except ChainError as error:
        raise RecordError(f"holds records that are not sound ({error})", "backup", "run 'wearline verify'") from error
    finally:
        records.close()


@contextmanager
def opened(path: Path) -> Iterator[tuple[Path, Manifest]]:
    """Unpack an archive beside itself and check all of it: every file's hash, the chain to its head.

    Raises:
        RecordError: it is no backup, damaged, or its records are not sound.
    """
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".restore-") as work:
        staged = Path(work)
        try:
            with tarfile.open(path) as archive:
                # The filter refuses links, devices and names that leave the folder.
                archive.extractall(staged, filter="data")
            about = json.loads((staged / _MANIFEST).read_text())
            if about.pop("format", None) != FORMAT:
                raise ValueError(f"it is no {FORMAT}")
            manifest = Manifest(**about)
        except (OSError, ValueError, TypeError, EOFError, tarfile.TarError) as error:
            raise RecordError(f"is no backup ({error})", str(path), "name a file of 'wearline backup'") from error
        found = {str(p.relative_to(staged)) for p in staged.rglob("*") if p.is_file()} - {_MANIFEST}
        for name in sorted(found ^ set(manifest.files)):
            raise RecordError(f"holds not what it says ({name})", str(path), "use another backup")
        for name, expected in manifest.files.items():
            if _sha256(staged / name) != expected:
                raise RecordError(f"is damaged ({name})", str(path), "use another backup")
        if _entries(staged) != manifest.entries:
            raise RecordError("holds another number of entries than it says", str(path), "use another backup")
        yield staged, manifest


def restore(staged: Path, data_dir: Path, records_url: str | None, done: Callable[[int], object]) -> None:
    """Put unpacked files in place; frames stay. With a URL the records go there, into an empty database.

    Raises:
        RecordError: they cannot be written, or the database holds records already.
    """
    try:
        if records_url is not None:
            source, target = open_engine(sqlite_url(staged / _RECORDS)), open_engine(records_url)
            try:
                with target.connect() as db:
                    if version_of(db):
                        raise RecordError("holds records already", records_url, "name an empty database")
                copy_tables(source, target, done)
            finally:
                source.dispose()
                target.dispose()
            (staged / _RECORDS).unlink()
        for path in sorted(staged.rglob("*")):
            name = path.relative_to(staged)
            if path.is_file() and str(name) != _MANIFEST:
                target_path = data_dir / name
                target_path.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target_path)
    except (OSError, SQLAlchemyError) as error:
        raise RecordError(
            f"cannot be restored ({str(error).splitlines()[0]})", str(data_dir), "check it and try again"
        ) from error


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
