"""Wear of every zone of every object: trend, forecast, alarms, maps, metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from prometheus_client import Gauge

from wearline.errors import RecordError, WearlineError
from wearline.messages import DieEvent, Verdict, WearTrend
from wearline.messages import WearMap as WearMapMessage
from wearline.metrics import gauge
from wearline.recipe import Recipe, parse_recipe
from wearline_judge.core.alarms import Acknowledged, Alarm, AlarmLevel, AlarmSettings, acknowledge, serviced, step
from wearline_judge.core.comparison import Comparison
from wearline_judge.core.decision import has_limits
from wearline_judge.core.forecast import RESTARTS
from wearline_judge.core.judgement import Setup
from wearline_judge.core.signs import read_signs
from wearline_judge.core.trend import Trend, wear_limit, wear_trend
from wearline_judge.core.wear_map import WearMap, empty_map, restored, updated
from wearline_judge.drivers.records import RecordStore, StoredAlarm, StoredMap
from wearline_judge.drivers.references import References
from wearline_judge.drivers.tables import PART

MEAN_ERROR = gauge("wearline_mean_error_millimeters", "Mean error of the newest measured part", ("cell", "object"))
WEAR = gauge("wearline_wear_millimeters", "Wear, as the trend sees it now", ("cell", "object", "zone"))
SLOPE = gauge("wearline_wear_slope_millimeters_per_kilostroke", "Slope of the wear trend", ("cell", "object", "zone"))
REMAINING = gauge("wearline_remaining_strokes", "Strokes until the wear limit", ("cell", "object", "zone", "quantile"))
ALARM = gauge(
    "wearline_alarm_level", "0 none, 1 info, 2 warning, 3 action, 4 stop, of a zone's wear", ("cell", "object", "zone")
)
SINCE_SERVICE = gauge("wearline_strokes_since_service", "Strokes since the last service of the die", ("cell", "object"))

WHOLE = "part"
"""Label of the whole part where a metric names a zone."""
_FITTED = 1000
"""Newest readings that a forecast is made from; all older ones are in the bins of the chart."""
_SHOWN = 300
_DECISIONS = 50
_MAP_KEPT_EVERY = 20
"""Parts between two writings of a wear map: a kill costs the map no more than these."""


@dataclass
class _Life:
    """One object since the last service of its die."""

    trends: dict[str, WearTrend] = field(default_factory=dict)
    waiting: list[str] = field(default_factory=list)
    """Zones whose trend is older than the newest record."""
    wear: WearMap | None = None
    wear_parts: int = 0


class Trends:
    """Kept up to date zone by zone, so that no verdict waits for more than one fit."""

    def __init__(
        self, cell: str, records: RecordStore, references: References, alarms: AlarmSettings,
        utc: Callable[[], datetime],
    ) -> None:  # fmt: skip
        self._cell, self._records, self._references = cell, records, references
        self._alarm_settings, self._utc = alarms, utc
        self._lives: dict[int, _Life] = {}

    # --- what happens ---

    def measured(self, verdict: Verdict, comparison: Comparison | None, setup: Setup | None) -> None:
        """A part was measured: its figures for the metrics, its cells for the wear map."""
        index = verdict.request.object_index
        if verdict.mean_error_mm is None:
            return
        MEAN_ERROR.labels(self._cell, str(index)).set(verdict.mean_error_mm)
        if comparison is None or setup is None:
            return
        life = self._life(index)
        wanted = empty_map(setup.golden.roi)
        if life.wear is None:
            life.wear = self._stored_map(index)
        if life.wear is None or (life.wear.origin_px, life.wear.count.shape) != (wanted.origin_px, wanted.count.shape):
            life.wear, life.wear_parts = wanted, 0
        life.wear = updated(life.wear, verdict.request.stroke, comparison, setup.cells)
        life.wear_parts += 1
        if life.wear_parts % _MAP_KEPT_EVERY == 0:
            self._keep_map(index, life)

    def recorded(self, index: int) -> None:
        """A cycle of this object has ended: its trends are due."""
        life = self._life(index)
        for zone in self._zones(index):
            if zone not in life.waiting:
                life.waiting.append(zone)

    def served(self, done: DieEvent, stroke: int) -> None:
        """The die was serviced, or got another coil."""
        index = done.object_index
        life = self._life(index)
        if done.kind in RESTARTS:
            self._lives[index] = life = _Life()
            self._records.drop_map(index)
            for alarm in self._records.alarms(index):
                self._records.keep_alarm(index, _stored(alarm.zone, serviced(_alarm(alarm), stroke)))
                ALARM.labels(self._cell, str(index), alarm.zone or WHOLE).set(0.0)
        life.waiting = list(self._zones(index))

    def acknowledged(self, index: int, zone: str, person: str, reason: str) -> None:
        """Somebody took notice of an alarm.

        Raises:
            AlarmError: there is nothing to acknowledge, or name or reason are missing.
            RecordError: it could not be written.
        """
        utc = self._utc()
        alarm = acknowledge(self._alarm(index, zone), person, utc.isoformat(timespec="seconds"), reason)
        self._records.append_acknowledgement(index, _stored(zone, alarm), utc)
        self._refreshed(index, zone)

    def tick(self) -> Iterator[str]:
        """Bring one trend up to date; yields a sentence where an alarm was raised."""
        for index, life in self._lives.items():
            if life.waiting:
                zone = life.waiting.pop(0)
                before = self._alarm(index, zone)
                after = self._refreshed(index, zone)
                if after.level > max(before.level, AlarmLevel.INFO):
                    where = f"object {index}" + (f", zone {zone}" if zone else "")
                    yield f"{where}: {after.level.name.lower()}: {after.reason}"
                return

    def close(self) -> None:
        """Write the maps."""
        for index, life in self._lives.items():
            with suppress(RecordError):
                self._keep_map(index, life)

    # --- what is asked ---

    def of(self, index: int) -> tuple[WearTrend, ...]:
        """The whole part first, then its zones."""
        life = self._life(index)
        found = []
        for zone in self._zones(index):
            if zone not in life.trends or (zone == PART and zone in life.waiting):
                self._refreshed(index, zone)
            found.append(life.trends[zone])
        return tuple(found)

    def map_of(self, index: int) -> WearMapMessage:
        """Where errors are frequent and where wear grows.

        Raises:
            RecordError: no part was measured since the last service.
        """
        life = self._life(index)
        wear = life.wear or self._stored_map(index)
        if wear is None:
            raise RecordError("has no measured part since its last service", f"object {index}", "measure some")
        slope, sigma = wear.slope()
        return WearMapMessage(
            object_index=index,
            maps=np.stack([wear.error_share, slope, sigma]).astype(np.float32),
            square_px=wear.square_px,
            origin_px=wear.origin_px,
            parts=int(wear.count.max()),
        )

    # --- inside ---

    def _life(self, index: int) -> _Life:
        return self._lives.setdefault(index, _Life())

    def _zones(self, index: int) -> tuple[str, ...]:
        return self._records.zones(index) or (PART,)

    def _recipe(self, index: int) -> Recipe | None:
        try:
            return parse_recipe(self._references.object_recipe(index).recipe_yaml)
        except WearlineError:
            # Records outlive the object list; a trend without a limit is still one.
            return None

    def _limit(self, index: int, zone: str, means: list[float], wears: list[float]) -> float | None:
        """The wear at which a zone fails a part; None where none is set. [mm]"""
        recipe = self._recipe(index)
        own = next((z for z in recipe.zones if z.name == zone), None) if recipe is not None else None
        if recipe is None or (zone != PART and own is None):
            return None
        limits = recipe.limits if own is None else own.limits
        if has_limits(recipe) and limits.max_error_mm is None and limits.mean_error_mm is None:
            # The precision fails a part only where the recipe limits nothing at all.
            return None
        precision_mm = (own.precision_mm if own is not None else None) or recipe.precision_mm
        return wear_limit(recipe.model_copy(update={"limits": limits, "precision_mm": precision_mm}), means, wears)

    def _refreshed(self, index: int, zone: str) -> Alarm:
        """Fit one zone anew, climb or descend its ladder, and keep both."""
        records, life = self._records, self._life(index)
        if zone in life.waiting:
            life.waiting.remove(zone)
        newest = records.newest_wear(index, zone, last=_FITTED)
        strokes, wears, means = ([row[k] for row in newest] for k in range(3))
        events = records.die_events(index)
        services = [stroke for stroke, kind in events if kind in RESTARTS]
        first = services[-1] if services else (records.first_stroke(index) or 0)
        coils = [stroke for stroke, kind in events if kind not in RESTARTS and stroke >= first]
        limit = self._limit(index, zone, means, wears)
        fitted = wear_trend([int(s) for s in strokes], wears, limit, first, coils)
        stroke = records.newest_stroke(index) or 0
        decisions = records.newest_decisions(index, _DECISIONS) if zone == PART else []
        signs = read_signs([int(s) for s in strokes], wears, fitted, decisions)
        before = self._alarm(index, zone)
        alarm = step(before, signs, stroke, self._alarm_settings) if newest or decisions else before
        if alarm != before:
            records.keep_alarm(index, _stored(zone, alarm))
        life.trends[zone] = self._said(index, zone, fitted, events, max(stroke - first, 0), alarm, len(newest))
        self._show(index, zone, life.trends[zone])
        return alarm

    def _said(
        self, index: int, zone: str, fitted: Trend, events: list[tuple[int, str]], since: int, alarm: Alarm, read: int
    ) -> WearTrend:
        points = fitted.points
        if read == _FITTED:
            bins = self._records.wear_bins(index, zone)
            thin = -(-len(bins) // _SHOWN)
            points = tuple((stroke, wear) for stroke, wear, _ in bins[(len(bins) - 1) % thin :: thin])
        seen = alarm.acknowledged
        return WearTrend(
            object_index=index,
            zone=zone,
            points=points,
            wear_mm=fitted.wear_mm,
            slope_mm_per_kilostroke=fitted.slope_mm_per_kilostroke,
            slope_sigma=fitted.slope_sigma,
            limit_mm=fitted.limit_mm,
            remaining_p10=fitted.remaining_p10,
            remaining_p50=fitted.remaining_p50,
            remaining_p90=fitted.remaining_p90,
            strokes_since_service=since,
            die_events=tuple(events),
            jumps=fitted.jumps,
            alarm_level=int(alarm.level),
            alarm_reason=alarm.reason,
            alarm_stroke=alarm.stroke,
            acknowledged_by=seen.person if seen else "",
            acknowledged_reason=seen.reason if seen else "",
        )

    def _show(self, index: int, zone: str, trend: WearTrend) -> None:
        place, name = (self._cell, str(index)), zone or WHOLE
        if zone == PART:
            SINCE_SERVICE.labels(*place).set(trend.strokes_since_service)
        ALARM.labels(*place, name).set(trend.alarm_level)
        _tell(WEAR, (*place, name), trend.wear_mm)
        _tell(SLOPE, (*place, name), trend.slope_mm_per_kilostroke)
        for quantile, strokes in (
            ("0.1", trend.remaining_p10), ("0.5", trend.remaining_p50), ("0.9", trend.remaining_p90)
        ):  # fmt: skip
            _tell(REMAINING, (*place, name, quantile), strokes)

    def _alarm(self, index: int, zone: str) -> Alarm:
        found = next((a for a in self._records.alarms(index) if a.zone == zone), None)
        return _alarm(found) if found is not None else Alarm()

    def _stored_map(self, index: int) -> WearMap | None:
        found = self._records.stored_map(index)
        return None if found is None else restored(found.square_px, found.origin_px, found.arrays)

    def _keep_map(self, index: int, life: _Life) -> None:
        if life.wear is not None:
            self._records.keep_map(index, StoredMap(life.wear.square_px, life.wear.origin_px, life.wear.arrays()))


def _tell(series: Gauge, labels: tuple[str, ...], value: float | None) -> None:
    """What is not known must not keep its last value on a dashboard: the series goes."""
    if value is not None:
        series.labels(*labels).set(value)
        return
    with suppress(KeyError):
        series.remove(*labels)


def _alarm(stored: StoredAlarm) -> Alarm:
    seen = Acknowledged(stored.person, stored.utc, stored.note) if stored.person else None
    return Alarm(AlarmLevel(stored.level), stored.stroke, stored.reason, seen)


def _stored(zone: str, alarm: Alarm) -> StoredAlarm:
    seen = alarm.acknowledged
    return StoredAlarm(
        zone, int(alarm.level), alarm.stroke, alarm.reason, seen.person if seen else "", seen.utc if seen else "",
        seen.reason if seen else "",
    )  # fmt: skip
