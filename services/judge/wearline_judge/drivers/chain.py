"""The chain over the records: each entry's hash covers the one before it, so that no entry can be altered unseen.

Whoever may write the database could compute a whole chain anew. So every so often the head is
signed with a key that lies beside the database, not in it; and where old entries were pruned, the
signed head stands for them.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from wearline.errors import RecordError

FIRST = "0" * 64
"""Stands before the first entry."""
SIGNED_EVERY = 1000
"""Entries between two signed checkpoints."""


@dataclass(frozen=True)
class Entry:
    """One line of the records as stored."""

    number: int
    """From 1, without gaps."""
    kind: str
    cycle_id: str
    utc: str
    body: str
    """The message as JSON."""
    previous: str
    digest: str


@dataclass(frozen=True)
class Checkpoint:
    """The head of the chain at one moment, signed."""

    number: int
    digest: str
    utc: str
    is_pruned: bool
    """The entries up to this one were removed on purpose."""
    signature: str


def digest(number: int, kind: str, cycle_id: str, utc: str, body: str, previous: str) -> str:
    """sha256 over all fields, hex; JSON keeps field borders unambiguous."""
    return hashlib.sha256(json.dumps([number, kind, cycle_id, utc, body, previous]).encode()).hexdigest()


def signature(key: bytes, number: int, entry_digest: str, utc: str, is_pruned: bool) -> str:
    """HMAC-SHA256 (RFC 2104) over the other fields of a checkpoint, hex."""
    return hmac.new(key, json.dumps([number, entry_digest, utc, is_pruned]).encode(), "sha256").hexdigest()


class ChainError(Exception):
    """The first entry that does not fit; its text says which and why."""


def checked(entries: Iterable[Entry], checkpoints: Iterable[Checkpoint], key: bytes) -> Iterator[Entry]:
    """Pass on the entries that fit the chain, oldest first, and end at its head.

    Raises:
        ChainError: an entry was altered, removed or put in; a checkpoint was.
    """
    signed: dict[int, Checkpoint] = {}
    for point in checkpoints:
        expected = signature(key, point.number, point.digest, point.utc, point.is_pruned)
        if not hmac.compare_digest(expected, point.signature):
            raise ChainError(f"checkpoint {point.number} was altered, or signed with another key")
        signed[point.number] = point
    pruned = max((n for n, point in signed.items() if point.is_pruned), default=0)
    number, previous = pruned, signed[pruned].digest if pruned else FIRST
    for entry in entries:
        number += 1
        if entry.number != number:
            raise ChainError(f"entry {number} is missing")
        if entry.previous != previous:
            raise ChainError(
                f"entry {number} ({entry.kind} of cycle {entry.cycle_id}) does not follow the one before it"
            )
        if entry.digest != digest(number, entry.kind, entry.cycle_id, entry.utc, entry.body, previous):
            raise ChainError(f"entry {number} ({entry.kind} of cycle {entry.cycle_id}) was altered")
        if number % SIGNED_EVERY == 0 and number not in signed:
            raise ChainError(f"checkpoint {number} is missing")
        if number in signed and signed[number].digest != entry.digest:
            raise ChainError(f"entry {number} ({entry.kind} of cycle {entry.cycle_id}) is not what was signed")
        previous = entry.digest
        yield entry
    if signed and max(signed) > number:
        raise ChainError(f"entry {number + 1} is missing: entry {max(signed)} was there and was signed")


def key_of(path: Path) -> bytes:
    """The key in a file, made at the first use; only its owner may read it.

    Raises:
        RecordError: it cannot be read or written.
    """
    try:
        try:
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(secrets.token_bytes(32))
                file.flush()
                os.fsync(file.fileno())
        except FileExistsError:
            pass
        key = path.read_bytes()
    except OSError as error:
        raise RecordError(f"cannot be used ({error.strerror})", str(path), "check its rights, or restore it") from error
    if len(key) < 16:
        raise RecordError("is no key", str(path), "restore it from a backup")
    return key
