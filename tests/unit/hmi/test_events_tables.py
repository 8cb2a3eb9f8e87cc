"""The event log, CSV, the map of wear and the watched signals."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wearline import messages as m
from wearline.errors import RecordError
from wearline_hmi.core import state as s
from wearline_hmi.core.maps import wear_map_bytes, wear_map_header
from wearline_hmi.core.state import CellState
from wearline_hmi.core.table import csv_lines, safe_cell
from wearline_hmi.drivers import event_log
from wearline_hmi.drivers.event_log import EventLog


def event(number: int, level: str = "info", text: str = "", service: str = "judge") -> m.Event:
    return m.Event(
        service=service, level=level, text=text or f"event {number}", utc=f"2026-01-01T00:00:{number:02d}.000+00:00",
        cycle_id=f"c-{number}",
    )  # fmt: skip


def test_events_are_kept_once_and_found_newest_first(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.db")
    for number in (2, 1, 3, 2):
        log.add(event(number))
    log.add(event(4, "error", "100%_full", "capture"))
    assert [e.utc[17:19] for e in log.find()] == ["04", "03", "02", "01"]
    assert [e.text for e in log.find("100%_")] == ["100%_full"]
    assert log.find("100x") == []
    assert [e.text for e in log.find("c-3")] == ["event 3"]
    assert [e.level for e in log.find(levels=("error", "warning"))] == ["error"]
    assert [e.service for e in log.find(service="capture")] == ["capture"]
    assert len(log.find(last=2)) == 2
    log.close()
    again = EventLog(tmp_path / "events.db")
    assert len(again.find()) == 4
    again.close()


def test_the_event_log_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_log, "KEPT", 5)
    monkeypatch.setattr(event_log, "_TIDY_EVERY", 2)
    log = EventLog(tmp_path / "events.db")
    for number in range(40):
        log.add(event(number))
    assert len(log.find()) <= 7
    log.close()


def test_a_broken_event_log_says_so(tmp_path: Path) -> None:
    path = tmp_path / "events.db"
    path.write_bytes(b"nonsense" * 1000)
    with pytest.raises(RecordError, match="event log"):
        EventLog(path)


@pytest.mark.parametrize(
    ("value", "text"),
    [("=1+1", "'=1+1"), ("+x", "'+x"), ("-x", "'-x"), ("@x", "'@x"), (" =x", "' =x"), ("\tx", "'\tx"),
     ("A4001", "A4001"), (-0.25, "-0.25"), (None, ""), (True, "1"), (3, "3"), (m.Decision.FAILED, "FAILED")],
)  # fmt: skip
def test_no_cell_is_taken_for_a_formula_and_numbers_stay_numbers(value: object, text: str) -> None:
    assert safe_cell(value) == text


def test_csv_is_read_back_as_it_was() -> None:
    rows = [["part", "reason"], ['A "7"', "one, two\nthree"]]
    assert list(csv.reader(csv_lines(rows).splitlines(keepends=True))) == rows


def test_the_map_of_wear_keeps_its_units_and_what_was_never_seen() -> None:
    maps = np.array([[[0.25, np.nan]], [[-1.5, np.nan]], [[0.1, np.nan]]], np.float32)
    wear_map = m.WearMap(object_index=3, maps=maps, square_px=16, origin_px=(0, 0), parts=8)
    header = wear_map_header(wear_map, 0.1)
    assert (header.cycle_id, header.rows, header.cols, header.unit) == ("3-8", 1, 2, "mm")
    assert header.step == pytest.approx(1.6)
    assert [(scale.unit, scale.high_mm) for scale in header.scales] == [("%", 50.0), ("mm/1000", 2.0)]
    back = np.frombuffer(wear_map_bytes(wear_map), "<f4").reshape(2, 1, 2)
    np.testing.assert_allclose(back, [[[25.0, np.nan]], [[-1.5, np.nan]]])


def test_a_map_of_wear_without_any_part_has_scales() -> None:
    maps = np.full((3, 2, 2), np.nan, np.float32)
    header = wear_map_header(m.WearMap(object_index=1, maps=maps, square_px=16, origin_px=(0, 0), parts=0), None)
    assert header.unit == "px"
    assert all(scale.high_mm > scale.low_mm for scale in header.scales)


def fieldbus(image_rows: Any) -> m.ServiceState:
    text = image_rows if isinstance(image_rows, str) else json.dumps(image_rows)
    return m.ServiceState(
        service="fieldbus", status="ready", pid=1, uptime_s=1, version="0", values={"image_rows": text}
    )  # fmt: skip


def row(name: str, value: object) -> dict[str, object]:
    return {"direction": "request", "address": "0.0", "type": "Bool", "name": name, "value": value, "meaning": "x"}


def test_changes_of_signals_are_watched_but_for_life_counters() -> None:
    state = s.with_service(CellState("c"), fieldbus([row("ready", False), row("plc_life", 1)]), 1.0)
    assert state.signal_changes == ()
    state = s.with_service(state, fieldbus([row("ready", True), row("plc_life", 2)]), 2.0)
    (change,) = state.signal_changes
    assert (change.name, change.before, change.after, change.at_s) == ("ready", "False", "True", 2.0)
    for number in range(3 * s.CHANGES_KEPT):
        state = s.with_service(state, fieldbus([row("ready", number % 2 == 0)]), 3.0)
    assert len(state.signal_changes) == s.CHANGES_KEPT


@pytest.mark.parametrize("rows", ["no json", "{}", [{"name": "x"}], "[1]"])
def test_rows_that_are_no_process_image_are_left_out(rows: Any) -> None:
    assert s.with_service(CellState("c"), fieldbus(rows), 1.0).signals == ()
