"""The journal of accepted cycles and their outcomes: append-only lines, on disk before the call returns.

A line is ``<crc32> <json>``. A torn tail (power cut in the middle of a write) is cut off when the journal is opened;
damage elsewhere costs the damaged lines alone. Files are rotated and the oldest go; cycles that have not ended are
carried over. A reserve file keeps room for the cycles in flight when the disk fills up.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from wearline.config import Settings
from wearline.errors import RecordError
from wearline.messages import JournalEntry, MeasureRequest, Outcome

ANSWER_ENTRIES = 1000
"""At most so many entries in one answer; who wants more asks again from the last one on."""


class JournalSettings(Settings):
    """How much the journal keeps, and when the disk counts as full."""

    file_bytes: int = Field(default=1 << 20, ge=4096)
    """A journal file beyond this is followed by the next. [bytes]"""
    files: int = Field(default=16, ge=2)
    """Of these the newest are kept."""
    reserve_bytes: int = Field(default=1 << 18, ge=4096)
    """Kept for the cycles in flight. [bytes]"""
    min_free_bytes: int = Field(default=16 << 20, ge=0)
    """Less free space on the disk than this withdraws Ready. [bytes]"""


class Disk:
    """The calls that can fail when a disk does."""

    def write(self, file: int, content: bytes) -> int:
        """`os.write`."""
        return os.write(file, content)

    def sync(self, file: int) -> None:
        """`os.fsync`."""
        os.fsync(file)

    def free_bytes(self, folder: Path) -> int:
        """What is left to an ordinary user. [bytes]"""
        found = os.statvfs(folder)
        return found.f_bavail * found.f_frsize


@dataclass(frozen=True)
class Entry:
    """One cycle as far as the journal knows it."""

    request: MeasureRequest
    accepted_utc: str
    outcome: Outcome | None = None
    is_ended: bool = False
    """The cell was told the outcome; what is still missing was lost with an earlier run."""

    def as_message(self) -> JournalEntry:
        """For who reconciles: an outcome that the PLC may not have been told yet is none."""
        return JournalEntry(
            request=self.request,
            is_simulated=self.request.is_simulated if self.outcome is None else self.outcome.is_simulated,
            accepted_utc=self.accepted_utc,
            outcome=self.outcome if self.is_ended else None,
        )


class Journal:
    """One folder of journal files, used by one thread."""

    def __init__(self, folder: Path, settings: JournalSettings, disk: Disk | None = None) -> None:
        """Read what is there and open the newest file.

        Raises:
            RecordError: the folder cannot be read or written.
        """
        self._folder, self._settings, self._disk = folder, settings, disk or Disk()
        self._entries: dict[str, Entry] = {}
        self._file: int | None = None
        self._size = 0
        self._is_faulty = False
        self.damaged_lines = 0
        """Lines that could not be read when the journal was opened, the torn tail not counted."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            numbers = self._numbers()
            for number in numbers:
                self._read(number, is_newest=number == numbers[-1])
            self._open(numbers[-1] if numbers else 1)
        except OSError as error:
            raise self._broken(error) from error
        self._make_reserve()

    @property
    def entries(self) -> dict[str, Entry]:
        """All cycles that are known, oldest first, by cycle id."""
        return self._entries

    def unfinished(self) -> list[Entry]:
        """Cycles that were accepted and not ended, oldest first."""
        return [entry for entry in self._entries.values() if not entry.is_ended]

    def since(self, utc: str) -> list[Entry]:
        """The oldest `ANSWER_ENTRIES` cycles accepted at or after an instant (ISO 8601, empty = all)."""
        found = [entry for entry in self._entries.values() if entry.accepted_utc >= utc]
        return found[:ANSWER_ENTRIES]

    def record_accepted(self, request: MeasureRequest, utc: str) -> None:
        """A cycle begins.

        Raises:
            RecordError: it is not on disk; nothing may be done about the cycle.
        """
        self._append({"kind": "accepted", "utc": utc, "request": request.model_dump(mode="json")})
        self._entries[request.cycle_id] = Entry(request, utc)
        self._forget()

    def record_outcome(self, outcome: Outcome) -> None:
        """A cycle is decided; the PLC is told after this.

        Raises:
            RecordError: it is not on disk; the PLC must not be told this outcome.
        """
        self._append({"kind": "outcome", "outcome": outcome.model_dump(mode="json", exclude={"request"})})
        self._change(outcome.cycle_id, outcome=outcome)

    def record_end(self, outcome: Outcome) -> None:
        """What the PLC was told is certain, and the cell knows it.

        Raises:
            RecordError: it is not on disk; a restart would tell the cell once more.
        """
        self._append({"kind": "end", "outcome": outcome.model_dump(mode="json", exclude={"request"})})
        self._change(outcome.cycle_id, outcome=outcome, is_ended=True)

    def check_room(self) -> bool:
        """Whether another cycle may begin: the reserve stands and enough of the disk is free."""
        try:
            if self._is_faulty:
                self._rotate()
                self._is_faulty = False
            if self._disk.free_bytes(self._folder) < self._settings.min_free_bytes:
                return False
        except OSError:
            return False
        return self._make_reserve()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    # --- files ---

    @property
    def _reserve(self) -> Path:
        return self._folder / "reserve"

    def _path(self, number: int) -> Path:
        return self._folder / f"journal-{number:08d}.log"

    def _numbers(self) -> list[int]:
        names = (path.stem.removeprefix("journal-") for path in self._folder.glob("journal-*.log"))
        return sorted(int(name) for name in names if name.isdigit())

    def _broken(self, error: OSError) -> RecordError:
        return RecordError(
            f"the journal cannot be used ({error.strerror or error})", str(self._folder), "free space, or mend the disk"
        )

    def _open(self, number: int) -> None:
        path = self._path(number)
        is_new = not path.exists()
        self.close()
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o640)
        self._number, self._size = number, os.fstat(self._file).st_size
        if is_new:
            self._sync_folder()

    def _sync_folder(self) -> None:
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _read(self, number: int, is_newest: bool) -> None:
        content = self._path(number).read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content) and is_newest:
            # The tail was torn by a power cut: what follows must begin on a line of its own.
            os.truncate(self._path(number), whole)
        for line in content[:whole].split(b"\n")[:-1]:
            try:
                self._take(_checked(line))
            except (ValueError, KeyError, TypeError, ValidationError):
                self.damaged_lines += 1

    def _take(self, line: dict[str, Any]) -> None:
        kind = line["kind"]
        if kind == "accepted":
            request = MeasureRequest(**line["request"])
            self._entries.setdefault(request.cycle_id, Entry(request, line["utc"]))
            return
        fields = line["outcome"]
        entry = self._entries.get(fields["cycle_id"])
        if entry is None:
            # Its beginning went with an older file.
            return
        outcome = Outcome(**fields, request=entry.request)
        self._entries[outcome.cycle_id] = replace(entry, outcome=outcome, is_ended=entry.is_ended or kind == "end")

    def _change(self, cycle_id: str, outcome: Outcome, is_ended: bool = False) -> None:
        entry = self._entries.get(cycle_id)
        if entry is not None:
            self._entries[cycle_id] = replace(entry, outcome=outcome, is_ended=is_ended or entry.is_ended)

    def _forget(self) -> None:
        # As many as the files can hold at most; one that has not ended stays.
        most = self._settings.files * self._settings.file_bytes // 512
        if len(self._entries) > most:
            oldest = next((name for name, entry in self._entries.items() if entry.is_ended), None)
            self._entries.pop(oldest or "", None)

    def _append(self, line: dict[str, Any]) -> None:
        text = json.dumps(line, separators=(",", ":"), ensure_ascii=False).encode()
        content = b"%08x %s\n" % (zlib.crc32(text), text)
        try:
            if self._file is None:
                raise OSError("it is closed")
            if self._is_faulty or self._size + len(content) > self._settings.file_bytes:
                self._rotate()
                self._is_faulty = False
            self._put(content)
        except OSError as first:
            try:
                # The reserve is for this very cycle.
                self._reserve.unlink()
                self._undo()
                self._put(content)
            except OSError:
                self._is_faulty = True
                with contextlib.suppress(OSError):
                    self._undo()
                raise self._broken(first) from first

    def _put(self, content: bytes) -> None:
        assert self._file is not None
        done = 0
        while done < len(content):
            done += self._disk.write(self._file, content[done:])
        self._disk.sync(self._file)
        self._size += len(content)

    def _undo(self) -> None:
        """Take back what a failed write left behind."""
        if self._file is not None:
            os.ftruncate(self._file, self._size)

    def _rotate(self) -> None:
        """Go on in the next file, beginning with the cycles that have not ended; the oldest files go."""
        self._open(max([*self._numbers(), 0]) + 1)
        for entry in self.unfinished():
            for content in _lines_of(entry):
                self._put(content)
        for number in self._numbers()[: -self._settings.files]:
            self._path(number).unlink(missing_ok=True)

    def _make_reserve(self) -> bool:
        """Whether the reserve stands."""
        if self._reserve.exists():
            return True
        draft = self._reserve.with_suffix(".new")
        try:
            with draft.open("wb") as file:
                left = self._settings.reserve_bytes
                while left > 0:
                    # Real blocks: a hole would be no reserve.
                    left -= self._disk.write(file.fileno(), b"\xa5" * min(left, 65536))
                self._disk.sync(file.fileno())
            draft.replace(self._reserve)
        except OSError:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)
            return False
        return True


def _checked(line: bytes) -> dict[str, Any]:
    """The content of one line.

    Raises:
        ValueError: it is damaged.
    """
    crc, _, text = line.partition(b" ")
    if crc != b"%08x" % zlib.crc32(text):
        raise ValueError("the checksum does not fit")
    found: dict[str, Any] = json.loads(text)
    return found


def _lines_of(entry: Entry) -> Iterator[bytes]:
    lines: list[dict[str, Any]] = [
        {"kind": "accepted", "utc": entry.accepted_utc, "request": entry.request.model_dump(mode="json")}
    ]
    if entry.outcome is not None:
        lines.append({"kind": "outcome", "outcome": entry.outcome.model_dump(mode="json", exclude={"request"})})
    for line in lines:
        text = json.dumps(line, separators=(",", ":"), ensure_ascii=False).encode()
        yield b"%08x %s\n" % (zlib.crc32(text), text)
