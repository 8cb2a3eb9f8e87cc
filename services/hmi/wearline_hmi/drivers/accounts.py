"""Users, sessions, read-only tokens and the audit log: one SQLite file that is the hmi's own."""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from wearline.errors import RecordError, UsageError
from wearline_hmi.core.passwords import FORGOTTEN_S, wait_s
from wearline_hmi.core.rights import ACCOUNT_ROLES, Role

VERSION = 1
AUDIT_KEPT = 100_000
ACTIVITY_S = 30.0
"""How exactly the last activity of a session is kept. [s]"""
SENDER_TRIES = 20
"""Wrong passwords of one sender over all names before it must wait, too."""
_SCHEMA = """
CREATE TABLE user (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE COLLATE NOCASE, role TEXT NOT NULL,
    secret TEXT NOT NULL, must_change INTEGER NOT NULL, created_utc TEXT NOT NULL) STRICT;
CREATE TABLE session (digest TEXT PRIMARY KEY, user_id INTEGER NOT NULL REFERENCES user(id) ON DELETE CASCADE,
    created_s REAL NOT NULL, active_s REAL NOT NULL, address TEXT NOT NULL) STRICT;
CREATE TABLE token (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, digest TEXT NOT NULL UNIQUE,
    created_utc TEXT NOT NULL, created_by TEXT NOT NULL) STRICT;
CREATE TABLE failure (sender TEXT PRIMARY KEY, count INTEGER NOT NULL, last_s REAL NOT NULL) STRICT;
CREATE TABLE audit (number INTEGER PRIMARY KEY AUTOINCREMENT, utc TEXT NOT NULL, user TEXT NOT NULL,
    address TEXT NOT NULL, deed TEXT NOT NULL, detail TEXT NOT NULL) STRICT;
"""


@dataclass(frozen=True)
class User:
    """One account."""

    id: int
    name: str
    role: Role
    secret: str
    """argon2id hash."""
    must_change: bool
    created_utc: str


@dataclass(frozen=True)
class Token:
    """One read-only token of the HTTP API; the token itself is not kept."""

    id: int
    name: str
    created_utc: str
    created_by: str


@dataclass(frozen=True)
class AuditEntry:
    """Who did what."""

    number: int
    utc: str
    user: str
    address: str
    deed: str
    detail: str


def digest(token: str) -> str:
    """What is kept of a session or token: whoever reads the file cannot use it."""
    return hashlib.sha256(token.encode()).hexdigest()


class Accounts:
    """Used from any thread."""

    def __init__(self, path: Path, idle_s: float, session_s: float, clock: Callable[[], float] = time.time) -> None:
        """Open, or make, the file.

        Raises:
            RecordError: not a database, damaged, of a newer version, or not writable.
        """
        self._path, self._idle_s, self._session_s, self._clock = path, idle_s, session_s, clock
        self._lock = threading.RLock()
        try:
            path.touch(mode=0o600)
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.execute("PRAGMA foreign_keys=ON")
            found = str(self._db.execute("PRAGMA quick_check(1)").fetchone()[0])
            version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
            if found == "ok" and version == 0:
                self._db.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version={VERSION}; COMMIT;")
        except (sqlite3.Error, OSError) as error:
            raise self._broken(str(error)) from error
        if found != "ok":
            raise self._broken(found)
        if version > VERSION:
            raise self._broken(f"it was written by a newer version, {version}")

    def _broken(self, what: str) -> RecordError:
        return RecordError(
            f"the users cannot be read ({what})",
            str(self._path),
            "restore a backup, or move the file away to set up anew",
        )

    @contextmanager
    def _change(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                self._db.execute("BEGIN IMMEDIATE")
                yield self._db
                self._db.execute("COMMIT")
            except sqlite3.OperationalError as error:
                raise RecordError(f"cannot be written ({error})", str(self._path), "make room on the disk") from error
            finally:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")

    def _read(self, sql: str, *values: object) -> list[tuple[object, ...]]:
        with self._lock:
            return self._db.execute(sql, values).fetchall()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    # --- users ---

    _USER = "SELECT id, name, role, secret, must_change, created_utc FROM user"

    def users(self) -> list[User]:
        """All accounts by name."""
        return [_user(row) for row in self._read(f"{self._USER} ORDER BY name")]

    def user(self, name: str) -> User | None:
        """The account of that name, in whatever case it is written."""
        rows = self._read(f"{self._USER} WHERE name = ?", name)
        return _user(rows[0]) if rows else None

    def has_users(self) -> bool:
        return bool(self._read("SELECT 1 FROM user LIMIT 1"))

    def add(self, name: str, role: Role, secret: str, must_change: bool, only_first: bool = False) -> User:
        """A new account.

        Raises:
            UsageError: a bad or taken name, or, with `only_first`, there is one already.
        """
        name = name.strip()
        if not 1 <= len(name) <= 40 or not name.isprintable():
            raise UsageError("A name has 1 to 40 printable characters.")
        if role not in ACCOUNT_ROLES:
            raise UsageError("A viewer needs no account.")
        with self._change() as db:
            if only_first and db.execute("SELECT 1 FROM user LIMIT 1").fetchone():
                raise UsageError("There is an administrator already.")
            try:
                db.execute(
                    "INSERT INTO user (name, role, secret, must_change, created_utc) VALUES (?,?,?,?,?)",
                    (name, role.value, secret, int(must_change), self._utc()),
                )
            except sqlite3.IntegrityError:
                raise UsageError("This name is taken.") from None
        user = self.user(name)
        assert user is not None
        return user

    def remove(self, name: str) -> None:
        """Delete an account with its sessions.

        Raises:
            UsageError: no such user, or the last administrator.
        """
        with self._change() as db:
            self._keep_an_administrator(db, name, None)
            db.execute("DELETE FROM user WHERE name = ?", (name,))

    def set_role(self, name: str, role: Role) -> None:
        """Give another role; it rules the open sessions from the next event on.

        Raises:
            UsageError: no such user, not a role of accounts, or the last administrator.
        """
        if role not in ACCOUNT_ROLES:
            raise UsageError("A viewer needs no account.")
        with self._change() as db:
            self._keep_an_administrator(db, name, role)
            db.execute("UPDATE user SET role = ? WHERE name = ?", (role.value, name))

    def set_secret(self, name: str, secret: str, must_change: bool, keep_session: str = "") -> None:
        """Another password; all sessions of the user end but the one with that digest."""
        with self._change() as db:
            db.execute("UPDATE user SET secret = ?, must_change = ? WHERE name = ?", (secret, int(must_change), name))
            db.execute(
                "DELETE FROM session WHERE digest <> ? AND user_id = (SELECT id FROM user WHERE name = ?)",
                (keep_session, name),
            )

    def _keep_an_administrator(self, db: sqlite3.Connection, name: str, role: Role | None) -> None:
        row = db.execute("SELECT role FROM user WHERE name = ?", (name,)).fetchone()
        if row is None:
            raise UsageError("There is no such user.")
        count = db.execute("SELECT count(*) FROM user WHERE role = ?", (Role.ADMINISTRATOR.value,)).fetchone()[0]
        if row[0] == Role.ADMINISTRATOR and role is not Role.ADMINISTRATOR and count == 1:
            raise UsageError("The last administrator stays.")

    # --- sessions ---

    def open_session(self, user: User, address: str) -> str:
        """A new session; the token that its cookie bears."""
        token, now_s = secrets.token_urlsafe(32), self._clock()
        with self._change() as db:
            db.execute(
                "DELETE FROM session WHERE created_s < ? OR active_s < ?",
                (now_s - self._session_s, now_s - self._idle_s),
            )
            db.execute("INSERT INTO session VALUES (?,?,?,?,?)", (digest(token), user.id, now_s, now_s, address))
        return token

    def session_user(self, token_digest: str, is_active: bool) -> User | None:
        """Whose session it is; None when it has ended. Only what a person did counts as activity, no polling."""
        now_s = self._clock()
        rows = self._read(
            "SELECT u.id, u.name, u.role, u.secret, u.must_change, u.created_utc, s.created_s, s.active_s "
            "FROM session s JOIN user u ON u.id = s.user_id WHERE s.digest = ?",
            token_digest,
        )
        if not rows:
            return None
        created_s, active_s = float(str(rows[0][6])), float(str(rows[0][7]))
        # A clock that was set back does not make a session older or younger than it may be.
        if now_s - created_s > self._session_s or now_s - active_s > self._idle_s or now_s < created_s - 60.0:
            self.close_session(token_digest)
            return None
        if is_active and now_s - active_s > ACTIVITY_S:
            with self._change() as db:
                db.execute("UPDATE session SET active_s = ? WHERE digest = ?", (now_s, token_digest))
        return _user(rows[0][:6])

    def close_session(self, token_digest: str) -> None:
        """Log out."""
        with self._change() as db:
            db.execute("DELETE FROM session WHERE digest = ?", (token_digest,))

    # --- wrong passwords ---

    def must_wait_s(self, name: str, address: str) -> float:
        """How long this sender must wait before it may try this name. [s]"""
        now_s = self._clock()
        return max(
            self._wait_s(f"{address} {name.strip().casefold()}", 0, now_s),
            self._wait_s(address, SENDER_TRIES, now_s),
        )

    def _wait_s(self, sender: str, free: int, now_s: float) -> float:
        rows = self._read("SELECT count, last_s FROM failure WHERE sender = ?", digest(sender))
        return wait_s(int(str(rows[0][0])) - free, max(0.0, now_s - float(str(rows[0][1])))) if rows else 0.0

    def note_failure(self, name: str, address: str) -> None:
        """A wrong password."""
        now_s = self._clock()
        with self._change() as db:
            db.execute("DELETE FROM failure WHERE last_s < ?", (now_s - FORGOTTEN_S,))
            for sender in (f"{address} {name.strip().casefold()}", address):
                db.execute(
                    "INSERT INTO failure VALUES (?, 1, ?) "
                    "ON CONFLICT (sender) DO UPDATE SET count = count + 1, last_s = excluded.last_s",
                    (digest(sender), now_s),
                )

    def note_success(self, name: str, address: str) -> None:
        """The right one: the wrong ones before it are forgotten."""
        with self._change() as db:
            db.execute("DELETE FROM failure WHERE sender = ?", (digest(f"{address} {name.strip().casefold()}"),))

    # --- tokens of the API ---

    def tokens(self) -> list[Token]:
        """All tokens by name."""
        rows = self._read("SELECT id, name, created_utc, created_by FROM token ORDER BY name")
        return [Token(int(str(r[0])), str(r[1]), str(r[2]), str(r[3])) for r in rows]

    def add_token(self, name: str, created_by: str) -> str:
        """A new read-only token; this is the only time that it is known.

        Raises:
            UsageError: a bad or taken name.
        """
        name = name.strip()
        if not 1 <= len(name) <= 40 or not name.isprintable():
            raise UsageError("A name has 1 to 40 printable characters.")
        token = "wl_" + secrets.token_urlsafe(32)
        with self._change() as db:
            try:
                db.execute(
                    "INSERT INTO token (name, digest, created_utc, created_by) VALUES (?,?,?,?)",
                    (name, digest(token), self._utc(), created_by),
                )
            except sqlite3.IntegrityError:
                raise UsageError("This name is taken.") from None
        return token

    def remove_token(self, name: str) -> None:
        """It is refused from now on."""
        with self._change() as db:
            db.execute("DELETE FROM token WHERE name = ?", (name,))

    def token_name(self, token: str) -> str | None:
        """Whose token it is; None for a stranger's."""
        rows = self._read("SELECT name FROM token WHERE digest = ?", digest(token))
        return str(rows[0][0]) if rows else None

    # --- audit ---

    def note(self, user: str, address: str, deed: str, detail: str = "") -> None:
        """Write one line of the audit log."""
        with self._change() as db:
            number = db.execute(
                "INSERT INTO audit (utc, user, address, deed, detail) VALUES (?,?,?,?,?)",
                (self._utc(), user, address, deed, detail[:1000]),
            ).lastrowid
            db.execute("DELETE FROM audit WHERE number <= ?", ((number or 0) - AUDIT_KEPT,))

    def audit(self, last: int = 200, search: str = "") -> list[AuditEntry]:
        """The newest lines that contain the text, newest first."""
        like = "%" + search.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%"
        rows = self._read(
            "SELECT number, utc, user, address, deed, detail FROM audit "
            "WHERE utc || ' ' || user || ' ' || address || ' ' || deed || ' ' || detail LIKE ? ESCAPE '\\' "
            "ORDER BY number DESC LIMIT ?",
            like,
            last,
        )
        return [AuditEntry(int(str(r[0])), *(str(value) for value in r[1:])) for r in rows]

    def _utc(self) -> str:
        return datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")


def _user(row: tuple[object, ...]) -> User:
    return User(int(str(row[0])), str(row[1]), Role(str(row[2])), str(row[3]), bool(row[4]), str(row[5]))
