"""The ladder of alarms of one zone: info, warning, action, stop; raised by signs, latched until acknowledged.

Pure: a state, what is known after a stroke, and the state that follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from pydantic import Field

from wearline.config import Settings
from wearline.errors import WearlineError
from wearline.messages import Decision


class AlarmLevel(IntEnum):
    """Rungs of the ladder, as `wearline_alarm_level` shows them."""

    NONE = 0
    INFO = 1
    """The wear has left its start (EWMA)."""
    WARNING = 2
    """The limit may come before the next planned stop."""
    ACTION = 3
    """The limit is reached for certain, or a reading fits nothing (Nelson 1)."""
    STOP = 4
    """Several parts in a row were not good."""


class AlarmError(WearlineError):
    """An alarm cannot be acknowledged as asked."""


class AlarmSettings(Settings):
    """When the ladder is climbed."""

    strokes_to_stop: int = Field(default=500, ge=0)
    """Strokes between planned stops, where the press does not tell."""
    bad_in_row: int = Field(default=3, ge=1)
    """Parts in a row that were not PASSED before the press should stop."""


@dataclass(frozen=True)
class Signs:
    """What is known of a zone after a stroke."""

    has_left_start: bool = False
    """The EWMA of the wear is beyond its limits."""
    remaining_p10: float | None = None
    """Strokes to the limit, pessimistic; None = not identifiable."""
    strokes_to_stop: int | None = None
    """To the next planned stop; None = the setting's."""
    is_beyond: bool = False
    """Wear minus its guard band is beyond the limit."""
    fits_nothing: bool = False
    """The newest residual breaks Nelson's rule 1."""
    bad_in_row: int = 0


def bad_in_row(decisions: Sequence[Decision]) -> int:
    """Newest parts in a row that were not PASSED; NOT_MEASURED neither counts nor breaks the row.

    Args:
        decisions: oldest first.
    """
    count = 0
    for decision in reversed(decisions):
        if decision is Decision.PASSED:
            break
        count += decision is not Decision.NOT_MEASURED
    return count


def due(signs: Signs, settings: AlarmSettings) -> tuple[AlarmLevel, str]:
    """The rung that the signs ask for, and why in words."""
    if signs.bad_in_row >= settings.bad_in_row:
        return AlarmLevel.STOP, f"{signs.bad_in_row} parts in a row were not good"
    if signs.is_beyond:
        return AlarmLevel.ACTION, "the wear is beyond its limit for certain"
    if signs.fits_nothing:
        return AlarmLevel.ACTION, "the newest reading is more than three standard deviations off the trend"
    stop = settings.strokes_to_stop if signs.strokes_to_stop is None else signs.strokes_to_stop
    if signs.remaining_p10 is not None and signs.remaining_p10 < stop:
        return (
            AlarmLevel.WARNING,
            f"the limit may come in {signs.remaining_p10:.0f} strokes, the next planned stop in {stop}",
        )
    if signs.has_left_start:
        return AlarmLevel.INFO, "the wear has left its start"
    return AlarmLevel.NONE, ""


@dataclass(frozen=True)
class Acknowledged:
    """Who took notice, when and why."""

    person: str
    utc: str
    """ISO 8601."""
    reason: str


@dataclass(frozen=True)
class Alarm:
    """State of one zone's ladder."""

    level: AlarmLevel = AlarmLevel.NONE
    stroke: int = 0
    """At which this rung was reached."""
    reason: str = ""
    acknowledged: Acknowledged | None = None

    @property
    def needs_person(self) -> bool:
        """Somebody should look and has not yet."""
        return self.level >= AlarmLevel.WARNING and self.acknowledged is None


def step(alarm: Alarm, signs: Signs, stroke: int, settings: AlarmSettings) -> Alarm:
    """The state after a stroke.

    A higher rung is taken at once and asks for a person anew. From warning on a rung is held until it
    was acknowledged, also when its cause has gone; after that the ladder follows the signs down.
    """
    level, reason = due(signs, settings)
    if level > alarm.level:
        return Alarm(level, stroke, reason)
    if level == alarm.level or alarm.needs_person:
        return alarm
    return Alarm(level, stroke, reason, alarm.acknowledged if level >= AlarmLevel.WARNING else None)


def acknowledge(alarm: Alarm, person: str, utc: str, reason: str) -> Alarm:
    """Take notice of the present rung; it stays until its cause has gone.

    Raises:
        AlarmError: nothing asks for a person, or name or reason are missing.
    """
    if not alarm.needs_person:
        raise AlarmError("has nothing to acknowledge", "alarm", "reload the page, somebody may have been first")
    if not person.strip() or not reason.strip():
        raise AlarmError("was not acknowledged without a name and a reason", "alarm", "give both")
    return replace(alarm, acknowledged=Acknowledged(person.strip(), utc, reason.strip()))


def serviced(alarm: Alarm, stroke: int) -> Alarm:
    """After a service that made the surface new: the ladder starts at its foot."""
    return Alarm(AlarmLevel.NONE, stroke) if alarm.level else alarm
