"""The events of all services, kept for those who look later: one SQLite file, bounded."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path

from wearline.errors import RecordError
from wearline.messages import Event

KEPT = 50_000
_TIDY_EVERY = 500
_SCHEMA = """
CREATE TABLE IF NOT EXISTS event (number INTEGER PRIMARY KEY AUTOINCREMENT, utc TEXT NOT NULL, service TEXT NOT NULL,
    level TEXT NOT NULL, text TEXT NOT NULL, cycle_id TEXT NOT NULL, UNIQUE (utc, service, text, cycle_id)) STRICT;
CREATE INDEX IF NOT EXISTS event_utc ON event (utc);
"""


class EventLog:
    """Used from any thread. The bus tells late joiners old events again: each is kept once."""

    def __init__(self, path: Path) -> None:
        """Open, or make, the file.

        Raises:
            RecordError: not a database, damaged, or not writable.
        """
        self._path, self._lock, self._added = path, threading.Lock(), 0
        try:
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            # A log line that is lost with the power is said again by nobody, and harms nothing.
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)
        except sqlite3.Error as error:
            raise RecordError(f"the event log cannot be used ({error})", str(path), "move the file away") from error

    def add(self, event: Event) -> None:
        """Keep one; the oldest go when there are too many.

        Raises:
            RecordError: it cannot be written.
        """
        try:
            with self._lock:
                self._db.execute(
                    "INSERT OR IGNORE INTO event (utc, service, level, text, cycle_id) VALUES (?,?,?,?,?)",
                    (event.utc, event.service, event.level, event.text, event.cycle_id),
                )
                self._added += 1
                if self._added % _TIDY_EVERY == 1:
                    self._db.execute("DELETE FROM event WHERE number <= (SELECT max(number) FROM event) - ?", (KEPT,))
        except sqlite3.Error as error:
            raise RecordError(f"the event log cannot be written ({error})", str(self._path), "make room") from error

    def find(self, search: str = "", levels: tuple[str, ...] = (), service: str = "", last: int = 200) -> list[Event]:
        """The newest ones that contain the text, newest first."""
        like = "%" + search.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%"
        marks = ",".join("?" * len(levels))
        sql = (
            "SELECT service, level, text, utc, cycle_id FROM event WHERE (text || ' ' || cycle_id) LIKE ? ESCAPE '\\'"
            + (f" AND level IN ({marks})" if levels else "")
            + (" AND service = ?" if service else "")
            + " ORDER BY utc DESC, number DESC LIMIT ?"
        )
        values = (like, *levels, *([service] if service else []), last)
        with self._lock:
            found = self._db.execute(sql, values).fetchall()
        return [Event(service=s, level=level, text=text, utc=utc, cycle_id=c) for s, level, text, utc, c in found]

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()
