"""The journal: on disk before the call returns, whole after any cut, bounded, and honest about a full disk."""

from __future__ import annotations

import errno
import os
from functools import partial
from pathlib import Path

import pytest

from wearline.errors import RecordError
from wearline.messages import MeasureRequest, Outcome
from wearline_fieldbus.drivers.journal import Disk, Journal, JournalSettings

SETTINGS = JournalSettings(min_free_bytes=0, reserve_bytes=4096, file_bytes=4096, files=3)


def request(number: int) -> MeasureRequest:
    return MeasureRequest(
        cycle_id=f"c{number}", is_simulated=False, object_index=1, part_id="Teil µ", stroke=number,
        measure_number=number, time_left_ms=2500.0,
    )  # fmt: skip


def outcome(number: int, was_told: bool = False) -> Outcome:
    return Outcome(
        cycle_id=f"c{number}", is_simulated=True, request=request(number), code=2, passed=False, failed=True,
        was_told=was_told, cycle_seconds=0.5, told_utc="2026-01-01T00:00:01",
    )  # fmt: skip


def utc(number: int) -> str:
    return f"2026-01-01T00:00:{number:02d}"


def whole_cycle(journal: Journal, number: int) -> None:
    journal.record_accepted(request(number), utc(number % 60))
    journal.record_outcome(outcome(number))
    journal.record_end(outcome(number, True))


class Faulty(Disk):
    """Fails when it is told to."""

    def __init__(self) -> None:
        self.room: int | None = None
        self.sync_fails = False
        self.free = 1 << 30

    def write(self, file: int, content: bytes) -> int:
        if self.room is None:
            return super().write(file, content)
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = super().write(file, content[: self.room])
        self.room -= done
        return done

    def sync(self, file: int) -> None:
        if self.sync_fails:
            raise OSError(errno.EIO, "Input/output error")
        super().sync(file)

    def free_bytes(self, folder: Path) -> int:
        return self.free


def test_entries_survive_a_restart(tmp_path: Path) -> None:
    journal = Journal(tmp_path, SETTINGS)
    whole_cycle(journal, 1)
    journal.record_accepted(request(2), utc(2))
    journal.record_outcome(outcome(2))
    journal.record_accepted(request(3), utc(3))
    # No close: a kill -9 gives no notice.
    again = Journal(tmp_path, SETTINGS)
    assert [(e.request.cycle_id, e.outcome is not None, e.is_ended) for e in again.entries.values()] == [
        ("c1", True, True), ("c2", True, False), ("c3", False, False),
    ]  # fmt: skip
    assert [e.request for e in again.unfinished()] == [request(2), request(3)]
    assert again.entries["c1"].outcome == outcome(1, True)
    assert [e.request.cycle_id for e in again.since(utc(2))] == ["c2", "c3"]
    # Decided is not told: who reconciled now would put on record what the next moment may change.
    message = again.entries["c2"].as_message()
    assert message.is_simulated and message.outcome is None
    assert again.entries["c1"].as_message().outcome == outcome(1, True)


def test_every_cut_of_the_tail_leaves_a_journal_that_goes_on(tmp_path: Path) -> None:
    first = Journal(tmp_path / "whole", SETTINGS)
    whole_cycle(first, 1)
    first.record_accepted(request(2), utc(2))
    content = (tmp_path / "whole" / "journal-00000001.log").read_bytes()
    ends = [i + 1 for i, byte in enumerate(content) if byte == 10]
    assert len(ends) == 4
    # From within the second line on; before it there is nothing to lose but the first.
    for length in (0, 1, ends[0] - 1, *range(ends[0], len(content) + 1)):
        folder = tmp_path / f"cut{length}"
        folder.mkdir()
        (folder / "journal-00000001.log").write_bytes(content[:length])
        journal = Journal(folder, SETTINGS)
        lines = sum(end <= length for end in ends)
        assert journal.damaged_lines == 0
        assert len(journal.entries) == (lines >= 1) + (lines >= 4)
        assert [e.request.cycle_id for e in journal.unfinished()] == {0: [], 1: ["c1"], 2: ["c1"], 3: [], 4: ["c2"]}[
            lines
        ]
        journal.record_accepted(request(5), utc(5))
        journal.close()
        again = Journal(folder, SETTINGS)
        assert "c5" in again.entries and again.damaged_lines == 0
        again.close()


def test_every_flipped_byte_costs_its_line_alone(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "whole", SETTINGS)
    for number in (1, 2, 3):
        journal.record_accepted(request(number), utc(number))
    content = (tmp_path / "whole" / "journal-00000001.log").read_bytes()
    second = content.index(b"\n") + 1, content.index(b"\n", content.index(b"\n") + 1)
    for at in range(*second, 7):
        folder = tmp_path / f"flip{at}"
        folder.mkdir()
        damaged = bytearray(content)
        damaged[at] ^= 0x20
        (folder / "journal-00000001.log").write_bytes(damaged)
        found = Journal(folder, SETTINGS)
        assert list(found.entries) == ["c1", "c3"] and found.damaged_lines in (1, 2)
        found.close()


def test_the_journal_is_bounded_and_open_cycles_are_carried_over(tmp_path: Path) -> None:
    journal = Journal(tmp_path, SETTINGS)
    journal.record_accepted(request(1), utc(1))
    journal.record_outcome(outcome(1))
    for number in range(2, 120):
        whole_cycle(journal, number)
    files = sorted(tmp_path.glob("journal-*.log"))
    assert len(files) == 3 and files[0].name != "journal-00000001.log"
    assert sum(f.stat().st_size for f in files) <= 3 * SETTINGS.file_bytes + 1024
    assert len(journal.entries) <= 3 * SETTINGS.file_bytes // 512
    again = Journal(tmp_path, SETTINGS)
    assert [e.request.cycle_id for e in again.unfinished()] == ["c1"] and again.unfinished()[0].outcome == outcome(1)
    assert "c119" in again.entries and again.entries["c119"].is_ended


@pytest.mark.parametrize("room", [0, 1, 40, 150])
def test_a_full_disk_spends_the_reserve_on_the_cycle_in_flight_and_accepts_no_other(tmp_path: Path, room: int) -> None:
    journal = Journal(tmp_path, SETTINGS.model_copy(update={"min_free_bytes": 1}))
    journal.record_accepted(request(1), utc(1))
    assert journal.check_room()

    class WithReserve(Faulty):
        """Room is what the reserve gave back, once it is gone."""

        def write(self, file: int, content: bytes) -> int:
            if not (tmp_path / "reserve").exists():
                return Disk.write(self, file, content)
            return super().write(file, content)

    full = WithReserve()
    full.room, full.free = room, 0
    journal._disk = full
    journal.record_outcome(outcome(1))
    assert not (tmp_path / "reserve").exists() and not journal.check_room()
    journal.record_end(outcome(1, True))
    again = Journal(tmp_path, JournalSettings(min_free_bytes=0, reserve_bytes=4096))
    assert again.entries["c1"].outcome == outcome(1, True) and again.damaged_lines == 0


def test_what_cannot_be_written_is_refused_and_the_journal_recovers(tmp_path: Path) -> None:
    disk = Faulty()
    journal = Journal(tmp_path, SETTINGS, disk)
    for fault in ("room", "sync"):
        disk.room, disk.sync_fails = (30, False) if fault == "room" else (None, True)
        number = 10 if fault == "room" else 20
        with pytest.raises(RecordError, match="the journal cannot be used"):
            journal.record_accepted(request(number), utc(1))
        assert f"c{number}" not in journal.entries and not journal.check_room()
        disk.room, disk.sync_fails = None, False
        assert journal.check_room()
        whole_cycle(journal, number + 1)
    again = Journal(tmp_path, SETTINGS)
    assert [e.request.cycle_id for e in again.entries.values() if e.is_ended] == ["c11", "c21"]


def test_too_little_free_space_withdraws_room(tmp_path: Path) -> None:
    disk = Faulty()
    journal = Journal(tmp_path, JournalSettings(min_free_bytes=1000), disk)
    assert journal.check_room()
    disk.free = 999
    assert not journal.check_room()
    disk.free = 1000
    assert journal.check_room()


def test_a_folder_that_cannot_be_used_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="journal cannot be used"):
        Journal(tmp_path / "file" / "below", SETTINGS)


def test_nothing_is_told_to_be_on_disk_before_it_was_synced(tmp_path: Path) -> None:
    synced: list[int] = []

    class Watching(Disk):
        def sync(self, file: int) -> None:
            synced.append(os.fstat(file).st_size)
            super().sync(file)

    journal = Journal(tmp_path, SETTINGS, Watching())
    count = len(synced)
    for write in (partial(journal.record_accepted, request(1), utc(1)), partial(journal.record_outcome, outcome(1))):
        write()
        assert len(synced) == count + 1 and synced[-1] == (tmp_path / "journal-00000001.log").stat().st_size
        count += 1
