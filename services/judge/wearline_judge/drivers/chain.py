"""The chain over the records: each entry's hash covers the one before it, so that no entry can be altered unseen."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass

FIRST = "0" * 64
"""Stands before the first entry."""
KINDS = ("verdict", "outcome", "die_event")


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


def digest(number: int, kind: str, cycle_id: str, utc: str, body: str, previous: str) -> str:
    """sha256 over all fields, hex; JSON keeps field borders unambiguous."""
    return hashlib.sha256(json.dumps([number, kind, cycle_id, utc, body, previous]).encode()).hexdigest()


def first_fault(entries: Iterable[Entry]) -> str | None:
    """What is wrong with the first entry that does not fit the chain, or None."""
    previous = FIRST
    for number, entry in enumerate(entries, 1):
        if entry.number != number:
            return f"entry {number} is missing"
        if entry.previous != previous:
            return f"entry {number} does not follow the one before it"
        if entry.digest != digest(number, entry.kind, entry.cycle_id, entry.utc, entry.body, previous):
            return f"entry {number} ({entry.kind} of cycle {entry.cycle_id}) was altered"
        previous = entry.digest
    return None
