"""The ladder of alarms."""

from __future__ import annotations

import pytest

from wearline.messages import Decision
from wearline_judge.core.alarms import (
    Alarm,
    AlarmError,
    AlarmLevel,
    AlarmSettings,
    Signs,
    acknowledge,
    bad_in_row,
    due,
    serviced,
    step,
)

SETTINGS = AlarmSettings(strokes_to_stop=500, bad_in_row=3)


@pytest.mark.parametrize(
    ("signs", "level"),
    [
        (Signs(), AlarmLevel.NONE),
        (Signs(has_left_start=True), AlarmLevel.INFO),
        (Signs(has_left_start=True, remaining_p10=501.0), AlarmLevel.INFO),
        (Signs(remaining_p10=499.0), AlarmLevel.WARNING),
        (Signs(remaining_p10=499.0, strokes_to_stop=400), AlarmLevel.NONE),
        (Signs(remaining_p10=10.0, is_beyond=True), AlarmLevel.ACTION),
        (Signs(fits_nothing=True), AlarmLevel.ACTION),
        (Signs(is_beyond=True, bad_in_row=2), AlarmLevel.ACTION),
        (Signs(bad_in_row=3), AlarmLevel.STOP),
    ],
)
def test_each_sign_has_its_rung(signs: Signs, level: AlarmLevel) -> None:
    found, reason = due(signs, SETTINGS)
    assert found is level
    assert bool(reason) == (level is not AlarmLevel.NONE)


def test_rungs_latch_until_somebody_took_notice_and_the_cause_has_gone() -> None:
    alarm = step(Alarm(), Signs(remaining_p10=100.0), 10, SETTINGS)
    assert alarm.level is AlarmLevel.WARNING and alarm.stroke == 10 and alarm.needs_person
    assert step(alarm, Signs(), 11, SETTINGS) == alarm, "nobody has seen it"
    seen = acknowledge(alarm, "Ada", "2026-01-01T00:00:00+00:00", "insert is ordered")
    assert not seen.needs_person and seen.acknowledged is not None and seen.acknowledged.person == "Ada"
    assert step(seen, Signs(remaining_p10=90.0), 12, SETTINGS) == seen, "its cause is still there"
    higher = step(seen, Signs(is_beyond=True), 13, SETTINGS)
    assert higher.level is AlarmLevel.ACTION and higher.needs_person, "a higher rung asks anew"
    taken = acknowledge(higher, "Ada", "2026-01-01T00:01:00+00:00", "die comes out tonight")
    assert step(taken, Signs(), 14, SETTINGS) == Alarm(AlarmLevel.NONE, 14)


def test_info_comes_and_goes_by_itself() -> None:
    alarm = step(Alarm(), Signs(has_left_start=True), 5, SETTINGS)
    assert alarm.level is AlarmLevel.INFO and not alarm.needs_person
    assert step(alarm, Signs(), 6, SETTINGS).level is AlarmLevel.NONE


def test_acknowledging_needs_an_alarm_a_name_and_a_reason() -> None:
    with pytest.raises(AlarmError, match="nothing to acknowledge"):
        acknowledge(Alarm(AlarmLevel.INFO), "Ada", "", "why")
    alarm = Alarm(AlarmLevel.STOP, 3, "bad")
    for person, reason in (("", "why"), ("Ada", " ")):
        with pytest.raises(AlarmError, match="name and a reason"):
            acknowledge(alarm, person, "", reason)


def test_a_service_clears_the_ladder() -> None:
    assert serviced(Alarm(AlarmLevel.STOP, 3, "bad"), 9) == Alarm(AlarmLevel.NONE, 9)


def test_bad_parts_in_a_row() -> None:
    passed, failed, unsure, lost = Decision.PASSED, Decision.FAILED, Decision.UNSURE, Decision.NOT_MEASURED
    assert bad_in_row([failed, passed, failed, unsure]) == 2
    assert bad_in_row([failed, lost, failed]) == 2
    assert bad_in_row([failed, passed]) == 0
    assert bad_in_row([]) == 0
