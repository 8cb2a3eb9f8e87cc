"""A cell that publishes what the real services would, without measuring anything, and answers what they answer.

``python -m tests.browser.feed CELL.yaml`` keeps one running for looking at the screens by hand.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline import messages as m
from wearline import topics
from wearline.bus import Bus, open_router
from wearline.config import CellSettings, load_cell
from wearline.recipe import Recipe, dump_recipe
from wearline.scene import StampedPart, part_of_stroke
from wearline_fieldbus.core.profiles import BASIC, Direction, image_rows

PUBLISHERS = ("capture", "reconstruct", "judge", "fieldbus")
MAP_ROWS, MAP_COLS, STEP_MM = 90, 140, 0.9
START_UTC = datetime(2026, 3, 2, 6, 0, 0, tzinfo=UTC)
LIMIT_MM = 0.1
OBJECTS = tuple(
    m.ObjectEntry(
        object_index=index, object_name=name, recipe_hash="e" * 64, calibration_hash="c" * 64, template_hash="d" * 64,
        version=2,
    )
    for index, name in ((1, "tray"), (2, "bracket"))
)  # fmt: skip


def heights_mm(part: StampedPart) -> NDArray[np.float64]:
    """The part's own surface on the grid of the view, (row, col). [mm]"""
    x = (np.arange(MAP_COLS) - MAP_COLS / 2) * STEP_MM
    y = (np.arange(MAP_ROWS) - MAP_ROWS / 2) * STEP_MM
    return part.own_height_mm(*np.meshgrid(x, y))


def maps_mm(stroke: int) -> NDArray[np.float32]:
    """Standard, measured, difference, error, with noise and a shadow that nothing was measured in. [mm]"""
    standard, measured = heights_mm(StampedPart()), heights_mm(part_of_stroke(stroke))
    difference = measured - standard + np.random.default_rng(stroke).normal(0, 0.006, standard.shape)
    difference[60:70, 20:32] = np.nan
    error = np.where(np.abs(difference) > 0.05, difference, np.where(np.isnan(difference), np.nan, 0.0))
    return np.stack([standard, standard + difference, difference, np.abs(error)]).astype(np.float32)


def picture(stroke: int, rows: int = 612, cols: int = 812) -> NDArray[np.uint8]:
    """JPEG of laser lines over the part; 1-d uint8."""
    y, x = np.mgrid[0:rows, 0:cols]
    z = cv2.resize(heights_mm(part_of_stroke(stroke)), (cols, rows))
    across = (y + 2.6 * z - 20.0) / 23.0
    stripe = np.exp(-0.5 * ((across - np.round(across)) * 23.0 / 2.2) ** 2)
    grain = np.random.default_rng(stroke).gamma(6.0, 1 / 6.0, (rows, cols))
    grey = 12 + 150 * stripe * grain * (0.75 + 0.25 * np.cos((x - cols / 2) / cols * 2.5))
    spot = np.exp(-0.5 * (((y - rows / 2) / 8) ** 2 + ((x - cols / 2) / 8) ** 2))
    grey = np.clip(grey + 220 * spot, 0, 255).astype(np.uint8)
    done, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert done
    return np.asarray(jpeg, np.uint8).reshape(-1)


class Feed:
    """Router and publishers of one cell; the hmi under test joins them."""

    def __init__(self, cell: CellSettings) -> None:
        self.cell = cell
        self.mode, self.object_index, self.is_link_up, self.is_ready = "auto", 1, True, True
        self.is_simulated = True
        self.exposure_us, self.gain_db = 10000.0, 0.0
        self.asked: list[m.Message] = []
        """Every question and command that was answered."""
        self.silent: set[str] = set()
        """Services that say no state."""
        self._router = open_router(cell)
        self._buses = {name: Bus(cell.cell, name, cell.router.endpoint) for name in PUBLISHERS}
        self._verdicts: list[m.Verdict] = []
        self._outcomes: dict[str, m.Outcome] = {}
        self._preview: m.Preview | None = None
        self._view: m.View | None = None
        self.alarm_level, self.acknowledged = 0, ("", "")
        self._die_events: list[tuple[int, str]] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        for bus in self._buses.values():
            bus.open(timeout_s=10)
        self._answers()
        for bus in self._buses.values():
            bus.announce()
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=self._breathe, name="feed", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Everybody leaves."""
        self._stop.set()
        self._thread.join(2)
        for bus in self._buses.values():
            bus.close()
        self._router.close()  # type: ignore[no-untyped-call]

    def leave(self, name: str) -> None:
        """One service dies."""
        self.silent.add(name)
        self._buses[name].close()

    def _breathe(self) -> None:
        while True:
            for name in PUBLISHERS:
                if name not in self.silent:
                    self._buses[name].publish(self._state(name))
            if self._preview is not None and "capture" not in self.silent:
                self._buses["capture"].publish(self._preview)
            if self._view is not None and "judge" not in self.silent:
                # The bus may drop views when it is busy; no test may depend on that.
                self._buses["judge"].publish(self._view)
            if self._stop.wait(0.5):
                return

    def _state(self, name: str) -> m.ServiceState:
        values: dict[str, float | int | str | bool | None] = {}
        if name == "fieldbus":
            values = {
                "mode": self.mode,
                "plc_link_up": self.is_link_up,
                "ready": self.is_ready,
                "object_index": self.object_index,
                "image_rows": json.dumps(image_rows(BASIC, self._image()), separators=(",", ":")),
                "profile": "basic",
                "handshake": "idle",
                "not_ready_because": "",
                "longest_exchange_ms": 2.4,
                "image_age_s": 0.02,
                "journal_has_room": True,
            }
        elif name == "capture":
            values = {
                "camera": "sim",
                "exposure_us": self.exposure_us,
                "gain_db": self.gain_db,
                "frames": len(self._verdicts),
            }
        return m.ServiceState(
            service=name, status="ready", pid=1, uptime_s=time.monotonic() - self._started_s, version="0", values=values
        )

    def _image(self) -> bytes:
        """What is on the wire: the newest stroke's request and response."""
        last = self._verdicts[-1] if self._verdicts else None
        code = 0 if last is None else last.code
        request = BASIC.encode(
            {
                "link_ok": self.is_link_up, "object_index": self.object_index,
                "measure_number": 0 if last is None else last.request.measure_number,
                "stroke": 0 if last is None else last.request.stroke,
            }, Direction.REQUEST,
        )  # fmt: skip
        response = BASIC.encode(
            {
                "ready": self.is_ready, "measure_finished": code > 0, "passed": code == 1, "failed": code > 1,
                "mode": self.mode == "auto", "simulated": True, "result_code": code,
            }, Direction.RESPONSE,
        )  # fmt: skip
        return request + response

    def event(self, service: str, level: str, text: str, utc: str = "", cycle_id: str = "") -> None:
        """One line for the log."""
        utc = utc or datetime.now(UTC).isoformat(timespec="milliseconds")
        self._buses[service].publish(m.Event(service=service, level=level, text=text, utc=utc, cycle_id=cycle_id))

    def show(self, stroke: int) -> None:
        """A new camera picture."""
        self._preview = m.Preview(
            jpeg=picture(stroke), frame_counter=stroke, is_simulated=self.is_simulated, step_px=2.0
        )
        self._buses["capture"].publish(self._preview)

    def stroke(
        self, stroke: int, decision: m.Decision | None = None, was_told: bool = True, quick: bool = False
    ) -> str:
        """One press stroke: picture, verdict, maps, outcome; by default what its wear deserves. Returns the cycle id.

        A quick one leaves picture and maps out.
        """
        maps = maps_mm(stroke)
        seen = np.abs(maps[2][np.isfinite(maps[2])])
        deviating = seen[seen > 0.05]
        mean = float(deviating.mean()) if deviating.size > 60 else 0.0
        if decision is None:
            decision = m.Decision.FAILED if mean > LIMIT_MM else m.Decision.PASSED
        request = m.MeasureRequest(
            cycle_id=f"20260302-{stroke:06d}", is_simulated=self.is_simulated, object_index=self.object_index,
            part_id=f"A{4000 + stroke}", stroke=stroke, measure_number=stroke % 65535 + 1, time_left_ms=2500.0,
        )  # fmt: skip
        code = {"PASSED": 1, "FAILED": 2, "UNSURE": 3}.get(decision.value, 12)
        reason = {
            1: "", 2: f"mean error {mean:.3f} mm exceeds 0.100 mm", 3: "inside the guard band",
            12: "coverage 0.41 is below 0.70",
        }[code]  # fmt: skip
        is_measured = code != 12
        largest = float(maps[2][np.isfinite(maps[2])][np.argmax(seen)])
        verdict = m.Verdict(
            cycle_id=request.cycle_id, is_simulated=self.is_simulated, request=request, decision=decision, code=code,
            reason=reason, mean_error_mm=mean if is_measured else None, max_error_mm=largest if is_measured else None,
            wear_mm=float(np.percentile(deviating, 95)) if deviating.size else 0.0,
            deviating_area_px=int(deviating.size),
            deviating_area_mm2=deviating.size * STEP_MM**2, coverage=0.987 if is_measured else 0.41,
            regions=(m.Region(
                area_px=int(deviating.size), area_mm2=deviating.size * STEP_MM**2, volume_mm3=12.5, mean_mm=mean,
                max_mm=largest, p95_mm=abs(largest), sigma_mm=0.004, row_px=640.0, col_px=1040.0,
                box_px=(900, 520, 280, 240),
            ),) if mean else (),
            zones=(m.ZoneResult(
                name="draw radius", mean_error_mm=mean, max_error_mm=largest, area_mm2=deviating.size * STEP_MM**2,
                wear_mm=mean, coverage=0.99, is_within=code == 1,
            ),),
            registration=m.RegistrationResult(dz_mm=0.021, tilt_x_mrad=0.11, tilt_y_mrad=-0.07, dx_mm=0.02, dy_mm=0.01),
            quality=m.FrameQuality(
                lines_seen=25, spot_found=True, stripe_width_px=2.2, saturated_fraction=0.0004, ambient_dn=12.0,
                contrast_dn=150.0,
            ),
            timings_ms={"reconstruct": 61.2, "judge": 18.9}, frame_hash="f" * 64, calibration_hash="c" * 64,
            template_hash="d" * 64, recipe_hash="e" * 64, code_version="0.1.0",
        )  # fmt: skip
        outcome = m.Outcome(
            cycle_id=request.cycle_id, is_simulated=self.is_simulated, request=request, code=code, passed=code == 1,
            failed=code != 1, was_told=was_told, cycle_seconds=0.118 + 0.0007 * (stroke % 13),
            told_utc=(START_UTC + timedelta(seconds=6 * stroke)).isoformat(timespec="milliseconds"),
        )  # fmt: skip
        with self._lock:
            self._verdicts.append(verdict)
            self._outcomes[verdict.cycle_id] = outcome
        if not quick:
            self.show(stroke)
            self._view = (
                m.View(
                    cycle_id=request.cycle_id, is_simulated=self.is_simulated, maps_mm=maps, step_px=9.0,
                    origin_px=(182.0, 207.0), mm_per_pixel=0.1, stroke=stroke, decision=decision,
                )
            )  # fmt: skip
            self._buses["judge"].publish(self._view)
        self._buses["judge"].publish(verdict)
        self._buses["fieldbus"].publish(outcome)
        return verdict.cycle_id

    # --- what judge, fieldbus and capture answer ---

    def _answers(self) -> None:
        self._answer("judge", topics.RECORDS, self._records)
        self._answer("judge", topics.RECIPE_LIST, lambda _: m.ObjectList(objects=OBJECTS))
        self._answer("judge", topics.RECIPE, self._recipe)
        self._answer("judge", topics.TEACH, lambda _: m.Done(ok=True, text="object 1: version 3, taught from 3 parts"))
        self._answer("judge", topics.DIE_EVENT, self._on_die_event)
        self._answer("judge", topics.WEAR_MAP, self._wear_map)
        self._answer("judge", topics.ACKNOWLEDGE, self._on_acknowledge)
        self._answer("fieldbus", topics.MODE, self._on_mode)
        self._answer("fieldbus", topics.SELECT_OBJECT, self._on_select)
        self._answer("fieldbus", topics.DO_MEASURE, self._on_measure)
        self._answer("capture", topics.SET_CAMERA, self._on_set_camera)

    def _recipe(self, question: m.Message) -> m.ObjectRecipe:
        assert isinstance(question, m.AskRecipe)
        entry = next(entry for entry in OBJECTS if entry.object_index == question.object_index)
        return m.ObjectRecipe(**entry.model_dump(), recipe_yaml=dump_recipe(Recipe(roi=(180, 200, 1280, 820))))

    def _on_die_event(self, wanted: m.Message) -> m.Done:
        assert isinstance(wanted, m.DieEvent)
        with self._lock:
            stroke = self._verdicts[-1].request.stroke if self._verdicts else 0
            self._die_events.append((stroke, f"{wanted.kind}: {wanted.note}" if wanted.note else wanted.kind))
        return m.Done(ok=True, text=f"{wanted.kind} of object {wanted.object_index} recorded at stroke {stroke}")

    def _wear_map(self, question: m.Message) -> m.WearMap:
        assert isinstance(question, m.AskWearMap)
        with self._lock:
            count = len(self._verdicts)
        difference = maps_mm(50)[2][::5, ::5]
        share = np.clip((np.abs(difference) - 0.03) / 0.07, 0, 1)
        slope = np.where(np.abs(difference) > 0.03, difference * 20.0, 0.0)
        return m.WearMap(
            object_index=question.object_index, maps=np.stack([share, slope, 0.1 + 0 * slope]).astype(np.float32),
            square_px=45, origin_px=(180, 200), parts=count,
        )  # fmt: skip

    def _on_acknowledge(self, wanted: m.Message) -> m.Done:
        assert isinstance(wanted, m.Acknowledge)
        self.acknowledged = (wanted.user, wanted.reason)
        return m.Done(ok=True, text="acknowledged")

    def _on_mode(self, wanted: m.Message) -> m.Done:
        assert isinstance(wanted, m.SetMode)
        self.mode = wanted.mode
        return m.Done(ok=True, text=f"mode {wanted.mode}")

    def _on_select(self, wanted: m.Message) -> m.Done:
        assert isinstance(wanted, m.SelectObject)
        if self.mode != "manual":
            return m.Done(ok=False, text="the PLC selects the object in automatic mode")
        self.object_index = wanted.object_index
        return m.Done(ok=True, text=f"object {wanted.object_index}")

    def _on_measure(self, wanted: m.Message) -> m.Done:
        if self.mode != "manual":
            return m.Done(ok=False, text="the PLC measures in automatic mode")
        return m.Done(ok=True, text="measuring")

    def _on_set_camera(self, wanted: m.Message) -> m.Done:
        assert isinstance(wanted, m.SetCamera)
        if wanted.exposure_us is not None:
            if wanted.exposure_us > 50000:
                return m.Done(ok=False, text="exposure_us is 60000, at most 50000")
            self.exposure_us = wanted.exposure_us
        if wanted.gain_db is not None:
            self.gain_db = wanted.gain_db
        return m.Done(ok=True, text=f"exposure {self.exposure_us:g} us, gain {self.gain_db:g} dB")

    def _answer(self, service: str, query: topics.Query, fn: Callable[[m.Message], m.Message]) -> None:
        def answer(question: m.Message) -> m.Message:
            self.asked.append(question)
            return fn(question)

        self._buses[service].answer(query, answer)

    def _row(self, number: int, verdict: m.Verdict) -> m.RecordRow:
        outcome = self._outcomes.get(verdict.cycle_id)
        request = verdict.request
        return m.RecordRow(
            record_id=number, cycle_id=verdict.cycle_id, utc="" if outcome is None else outcome.told_utc,
            object_index=request.object_index, part_id=request.part_id, stroke=request.stroke,
            measure_number=request.measure_number, decision=verdict.decision, code=verdict.code, reason=verdict.reason,
            mean_error_mm=verdict.mean_error_mm, max_error_mm=verdict.max_error_mm, wear_mm=verdict.wear_mm,
            told_code=outcome.code if outcome is not None and outcome.was_told else None,
            cycle_seconds=None if outcome is None else outcome.cycle_seconds, is_simulated=verdict.is_simulated,
            verdict_json=verdict.model_dump_json(),
        )  # fmt: skip

    def _records(self, question: m.Message) -> m.Records:
        assert isinstance(question, m.AskRecords)
        with self._lock:
            verdicts = list(self._verdicts)
        rows = [self._row(number, verdict) for number, verdict in enumerate(verdicts, 1)]
        chosen = [
            row if question.with_verdict else row.replace(verdict_json="")
            for row in reversed(rows)
            if (not question.cycle_id or row.cycle_id == question.cycle_id)
            and (question.object_index is None or row.object_index == question.object_index)
            and (not question.decisions or row.decision in question.decisions)
            and (question.search.lower() in row.part_id.lower() or question.search == str(row.stroke))
            and (question.before is None or row.record_id < question.before)
        ]
        count = {d: sum(row.decision is d for row in rows) for d in m.Decision}
        return m.Records(
            rows=tuple(chosen[: question.last]), total=len(rows),
            trends=self._trends(verdicts) if question.with_trends else (),
            passed=count[m.Decision.PASSED], failed=count[m.Decision.FAILED],
            not_measured=count[m.Decision.NOT_MEASURED],
        )  # fmt: skip

    def _trends(self, verdicts: list[m.Verdict]) -> tuple[m.WearTrend, ...]:
        points = tuple((v.request.stroke, v.mean_error_mm) for v in verdicts if v.mean_error_mm is not None)
        if not points:
            return ()
        last, wear = points[-1]
        has_forecast = len(points) >= 10 and 0 < wear < LIMIT_MM
        left = (LIMIT_MM - wear) / max(wear, 1e-6) * 20 if has_forecast else None
        return (
            m.WearTrend(
                object_index=self.object_index, points=points, wear_mm=wear, slope_mm_per_kilostroke=1.52,
                slope_sigma=0.09, limit_mm=LIMIT_MM, remaining_p10=None if left is None else 0.7 * left,
                remaining_p50=left, remaining_p90=None if left is None else 1.5 * left,
                strokes_since_service=last - (self._die_events[-1][0] if self._die_events else 0),
                die_events=tuple(self._die_events), alarm_level=self.alarm_level,
                alarm_reason="limit in fewer than 20 strokes" if self.alarm_level else "", alarm_stroke=last,
                acknowledged_by=self.acknowledged[0], acknowledged_reason=self.acknowledged[1],
            ),
        )  # fmt: skip


def main() -> None:
    """Strokes every two seconds until interrupted."""
    feed = Feed(load_cell(Path(sys.argv[1])))
    for stroke in range(1, 40):
        feed.stroke(stroke, quick=True)
    feed.event("capture", "warning", "exposure was lowered to 9500 us")
    try:
        for stroke in range(40, 100000):
            feed.stroke(40 + (stroke - 40) % 40)
            time.sleep(2)
    except KeyboardInterrupt:
        feed.close()


if __name__ == "__main__":
    main()
