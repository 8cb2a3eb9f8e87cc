"""One full example of every message, for whoever needs one."""

from __future__ import annotations

from typing import Any

import numpy as np

from wearline import messages as m

CYCLE: dict[str, Any] = {"cycle_id": "20260101-000001", "is_simulated": True}


def measure_request(stroke: int = 7) -> m.MeasureRequest:
    """A request; the stroke tells two apart."""
    return m.MeasureRequest(
        cycle_id=f"cycle-{stroke}",
        is_simulated=True,
        object_index=3,
        part_id="Teil 7 µ",
        stroke=stroke,
        measure_number=stroke % 65536,
        time_left_ms=2500.25,
    )


REQUEST = measure_request()
QUALITY = m.FrameQuality(lines_seen=25, spot_found=True, stripe_width_px=2.5, sentences=("two lines are missing",))
REGION = m.Region(
    area_px=900, area_mm2=20.5, volume_mm3=2.5, mean_mm=0.12, max_mm=-0.3, p95_mm=0.25, sigma_mm=0.01,
    row_px=10.5, col_px=20.5, box_px=(1, 2, 3, 4),
)  # fmt: skip
ZONE = m.ZoneResult(
    name="radius", mean_error_mm=0.1, max_error_mm=None, area_mm2=3.0, wear_mm=0.2, coverage=0.9, is_within=False,
    profile_mm=0.6,
)  # fmt: skip
VERDICT = m.Verdict(
    **CYCLE, request=REQUEST, decision=m.Decision.FAILED, code=2, reason="worn", mean_error_mm=0.12, max_error_mm=-0.3,
    wear_mm=0.25, profile_mm=0.6, deviating_area_mm2=20.5, deviating_area_px=900, coverage=0.98, regions=(REGION,),
    zones=(ZONE,),
    registration=m.RegistrationResult(dz_mm=0.01, turn_mrad=-0.2, undetermined=("dx",), datum="zones"), quality=QUALITY,
    timings_ms={"judge": 5.5},
    frame_hash="f", calibration_hash="c", template_hash="t", recipe_hash="r", code_version="1",
)  # fmt: skip
OUTCOME = m.Outcome(
    **CYCLE, request=REQUEST, code=2, passed=False, failed=True, was_told=True, cycle_seconds=0.12,
    told_utc="2026-01-01T00:00:00+00:00",
)  # fmt: skip
ENTRY = m.ObjectEntry(
    object_index=3, object_name="bracket", recipe_hash="r", calibration_hash="c", template_hash="t", version=2
)
ROW = m.RecordRow(
    record_id=1, cycle_id="x", utc="2026-01-01T00:00:00+00:00", object_index=3, part_id="", stroke=7, measure_number=7,
    decision=m.Decision.PASSED, code=1, reason="", mean_error_mm=0.0, max_error_mm=None, wear_mm=0.0, told_code=None,
    cycle_seconds=None, is_simulated=True,
)  # fmt: skip
TREND = m.WearTrend(
    object_index=3, points=((1, 0.01), (2, 0.02)), wear_mm=0.02, slope_mm_per_kilostroke=10.0, slope_sigma=None,
    limit_mm=0.1, remaining_p10=None, remaining_p50=8.0, remaining_p90=None, strokes_since_service=2,
    die_events=((0, "regrind"),), zone="radius", jumps=((5, 0.02),), alarm_level=2, alarm_reason="near", alarm_stroke=4,
)  # fmt: skip

EXAMPLES: tuple[m.Message, ...] = (
    REQUEST,
    m.Frame(
        **CYCLE, request=REQUEST, camera="sim", pixels=np.arange(12, dtype=np.uint8).reshape(3, 4), exposure_us=1e4,
        frame_counter=9,
    ),
    m.Frame(
        **CYCLE, request=REQUEST, camera="sim", pixels=np.zeros((0, 0), np.uint8), exposure_us=1e4, frame_counter=9,
        refusal_code=16, refusal="camera does not answer",
    ),
    m.Exposed(**CYCLE),
    m.LinePoints(
        **CYCLE, request=REQUEST, points=np.array([[0, 1.5, 2, 0.125, 0.01]], np.float32), quality=QUALITY,
        timings_ms={"peaks": 3.25}, coverage=0.5, frame_hash="f", calibration_hash="c", recipe_hash="r",
    ),
    VERDICT,
    m.View(
        **CYCLE, maps_mm=np.array([[[np.nan, 1.0]], [[2.0, 3.0]]], np.float32), names=("standard", "measured"),
        step_px=4.0, origin_px=(0.0, 2.0),
    ),
    OUTCOME,
    m.Preview(jpeg=np.frombuffer(b"\xff\xd8", np.uint8), frame_counter=3, is_simulated=True, step_px=2.0),
    m.ServiceState(
        service="capture", status="ready", pid=1, uptime_s=2.5, version="0",
        values={"a": 1, "b": 0.5, "c": None, "d": True}
    ),
    m.Event(service="capture", level="error", text="two\nlines", utc="2026-01-01T00:00:00+00:00"),
    QUALITY, REGION, ZONE, m.RegistrationResult(), m.Ask(), m.Ping(), m.AskArtifact(content_hash="ab"),
    m.Artifact(content_hash="ab", content=np.frombuffer(b"npz", np.uint8)), m.AskRecipe(object_index=3),
    m.ObjectRecipe(
        object_index=3, object_name="bracket", recipe_yaml="{}", recipe_hash="r", calibration_hash="c",
        template_hash="t", version=2,
    ),
    ENTRY, m.ObjectList(objects=(ENTRY,)),
    m.AskRecords(last=5, decisions=(m.Decision.FAILED,), search="A4", before=9),
    ROW, TREND,
    m.Records(rows=(ROW,), total=1, trends=(TREND,)), m.Do(), m.DoMeasure(user="ada"), m.SelectObject(object_index=3),
    m.SetMode(mode="auto"), m.AskJournal(),
    m.JournalEntry(request=REQUEST, is_simulated=True, accepted_utc="2026-01-01T00:00:00+00:00", outcome=OUTCOME),
    m.Journal(entries=()), m.SetCamera(exposure_us=500.0), m.Teach(object_index=3, cycle_ids=("a", "b")),
    m.DieEvent(object_index=3, kind="regrind"), m.Acknowledge(object_index=3, zone="radius", reason="seen, next break"),
    m.AskWearMap(object_index=3),
    m.WearMap(
        object_index=3, maps=np.array([[[np.nan, 0.5]], [[2.0, 3.0]], [[0.1, 0.2]]], np.float32), square_px=32,
        origin_px=(0, 8), parts=7,
    ),
    m.Done(ok=False, text="not now"),
)  # fmt: skip
