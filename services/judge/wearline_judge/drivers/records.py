"""The production records: SQLite, WAL, synchronous FULL; an entry is on disk when the call returns."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from wearline.errors import RecordError
from wearline_judge.core.records import FIRST, Entry, digest, first_fault

_SCHEMA = """
CREATE TABLE IF NOT EXISTS entry (
    number INTEGER PRIMARY KEY, kind TEXT NOT NULL, cycle_id TEXT NOT NULL, utc TEXT NOT NULL,
    body TEXT NOT NULL, previous TEXT NOT NULL, digest TEXT NOT NULL, UNIQUE (kind, cycle_id)
)
"""


class RecordFile:
    """One chained file of entries; used by one thread."""

    def __init__(self, path: Path) -> None:
        """Open, or make, the file.

        Raises:
            RecordError: not a database, damaged, or not writable.
        """
        self._path = path
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.execute(_SCHEMA)
            found = str(self._db.execute("PRAGMA quick_check(1)").fetchone()[0])
        except sqlite3.Error as error:
            raise self._broken(str(error)) from error
        if found != "ok":
            raise self._broken(found)

    def _broken(self, what: str) -> RecordError:
        return RecordError(
            f"the records cannot be used ({what})", str(self._path), "restore a backup, or move the file away"
        )

    def append(self, kind: str, cycle_id: str, utc: str, body: str) -> bool:
        """Commit one entry; False where this cycle already has one of this kind.

        Raises:
            RecordError: it could not be made durable (disk full, damaged file).
        """
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                last = self._db.execute("SELECT number, digest FROM entry ORDER BY number DESC LIMIT 1").fetchone()
                number, previous = (last[0] + 1, last[1]) if last else (1, FIRST)
                row = (number, kind, cycle_id, utc, body, previous)
                self._db.execute(
                    "INSERT INTO entry VALUES (?,?,?,?,?,?,?)", (*row, digest(*row)),
                )  # fmt: skip
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        except sqlite3.IntegrityError:
            return False
        except sqlite3.Error as error:
            raise self._broken(str(error)) from error
        return True

    def entries(self) -> Iterator[Entry]:
        """All entries, oldest first."""
        for row in self._db.execute("SELECT * FROM entry ORDER BY number"):
            yield Entry(*row)

    def verify(self) -> str | None:
        """What is wrong with the first altered entry, or None."""
        return first_fault(self.entries())

    def close(self) -> None:
        """Close the file."""
        self._db.close()
