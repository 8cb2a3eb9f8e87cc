"""Charts as ECharts options: plain values, so that what a chart shows can be tested."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from wearline.messages import WearTrend
from wearline_hmi.core.language import Language


@dataclass(frozen=True)
class Ink:
    """Colours of a chart; each has a contrast of 4.5 at least against its ground (3 for lines)."""

    text: str
    grid: str
    line: str
    limit: str
    band: str
    event: str


INKS = {
    "light": Ink("#3c4a57", "#d7dee5", "#0b5cad", "#b3261e", "rgba(11,92,173,0.16)", "#7a4f00"),
    "dark": Ink("#b6c3cf", "#33414d", "#6cb6ff", "#ff8a80", "rgba(108,182,255,0.20)", "#f0b429"),
}


@dataclass(frozen=True)
class Forecast:
    """Where the wear is expected to go: abscissae [stroke] and the band about the middle line. [mm]"""

    strokes: tuple[int, ...]
    low_mm: tuple[float, ...]
    middle_mm: tuple[float, ...]
    high_mm: tuple[float, ...]


def forecast_of(trend: WearTrend, steps: int = 12) -> Forecast | None:
    """Straight lines from the newest point to the limit, by the three quantiles of the remaining strokes.

    None where they are not identifiable. The view ends where it would be longer than four times what was seen.
    """
    p10, p50, p90 = trend.remaining_p10, trend.remaining_p50, trend.remaining_p90
    if p10 is None or p50 is None or p90 is None or trend.limit_mm is None or not trend.points:
        return None
    if trend.wear_mm is None or min(p10, p50, p90) <= 0 or trend.wear_mm >= trend.limit_mm:
        return None
    first, last = trend.points[0][0], trend.points[-1][0]
    reach = min(p90, 4.0 * max(last - first, 1))
    rise = trend.limit_mm - trend.wear_mm

    def at(quantile: float) -> tuple[float, ...]:
        return tuple(
            min(trend.limit_mm or 0.0, (trend.wear_mm or 0.0) + rise * reach * k / steps / quantile)
            for k in range(steps + 1)
        )

    return Forecast(tuple(round(last + reach * k / steps) for k in range(steps + 1)), at(p90), at(p50), at(p10))


def axis(ink: Ink, name: str = "", **more: Any) -> dict[str, Any]:
    """One value axis."""
    return {
        "type": "value",
        "name": name,
        "nameLocation": "middle",
        "nameGap": 28,
        "scale": True,
        "nameTextStyle": {"color": ink.text},
        "axisLabel": {"color": ink.text, "hideOverlap": True},
        "axisLine": {"lineStyle": {"color": ink.grid}},
        "splitLine": {"lineStyle": {"color": ink.grid}},
        **more,
    }


def trend_chart(trend: WearTrend | None, ink: Ink, say: Language, can_zoom: bool = False) -> dict[str, Any]:
    """Wear against the stroke counter with its limit, die events and forecast."""
    series: list[dict[str, Any]] = []
    top = 0.0
    if trend is not None:
        marks: list[dict[str, Any]] = []
        if trend.limit_mm is not None:
            top = trend.limit_mm
            marks.append(
                {
                    "yAxis": trend.limit_mm,
                    "name": say("limit"),
                    "lineStyle": {"color": ink.limit, "type": "solid", "width": 2},
                    "label": {"formatter": say("limit"), "color": ink.limit, "position": "insideEndTop"},
                }
            )
        marks += [
            {
                "xAxis": stroke,
                "name": what,
                "lineStyle": {"color": ink.event, "type": "dashed"},
                "label": {"formatter": say(what.partition(":")[0]), "color": ink.event, "rotate": 0},
            }
            for stroke, what in trend.die_events
        ]
        top = max([top, *(wear for _, wear in trend.points)])
        series.append(
            {
                "name": say("wear"),
                "type": "line",
                "showSymbol": len(trend.points) < 60,
                "symbolSize": 5,
                "data": [[stroke, round(wear, 4)] for stroke, wear in trend.points],
                "lineStyle": {"color": ink.line, "width": 2},
                "itemStyle": {"color": ink.line},
                "markLine": {"symbol": "none", "silent": True, "data": marks},
            }
        )
        series += _forecast_series(trend, ink, say)
    zoom = [{"type": "inside"}, {"type": "slider", "height": 18, "bottom": 4, "textStyle": {"color": ink.text}}]
    return {
        "animation": False,
        "textStyle": {"color": ink.text},
        "grid": {"left": 58, "right": 18, "top": 16, "bottom": 78 if can_zoom else 44},
        "tooltip": {"trigger": "axis"},
        "dataZoom": zoom if can_zoom else [],
        "xAxis": axis(ink, say("stroke"), splitLine={"show": False}),
        "yAxis": axis(ink, say("wear [mm]"), nameGap=42, min=0, max=round(1.15 * top, 3) if top else None),
        "series": series,
    }


def _forecast_series(trend: WearTrend, ink: Ink, say: Language) -> list[dict[str, Any]]:
    forecast = forecast_of(trend)
    if forecast is None:
        return []
    quiet = {"type": "line", "showSymbol": False, "silent": True, "tooltip": {"show": False}}
    rise = [high - low for low, high in zip(forecast.low_mm, forecast.high_mm, strict=True)]
    return [
        {
            **quiet,
            "name": "low",
            "stack": "forecast",
            "lineStyle": {"opacity": 0},
            "data": list(map(list, zip(forecast.strokes, forecast.low_mm, strict=True))),
        },
        {
            **quiet,
            "name": say("80 % of the forecasts"),
            "stack": "forecast",
            "lineStyle": {"opacity": 0},
            "areaStyle": {"color": ink.band},
            "data": list(map(list, zip(forecast.strokes, rise, strict=True))),
        },
        {
            **quiet,
            "name": say("forecast"),
            "lineStyle": {"color": ink.line, "type": "dashed", "width": 2},
            "data": list(map(list, zip(forecast.strokes, forecast.middle_mm, strict=True))),
        },
    ]


def trend_sentence(trend: WearTrend | None, say: Language) -> str:
    """The trend in words, for those who cannot see the chart and for the line below it."""
    if trend is None or not trend.points:
        return say("No wear trend yet")
    parts = [say("{n} strokes since the last service", n=trend.strokes_since_service)]
    if trend.wear_mm is not None:
        parts.append(say("wear {mm} mm", mm=say.number(f"{trend.wear_mm:.3f}")))
    if trend.slope_mm_per_kilostroke is not None:
        parts.append(say("{mm} mm per 1000 strokes", mm=say.number(f"{trend.slope_mm_per_kilostroke:+.3f}")))
    if trend.remaining_p10 is not None and trend.remaining_p50 is not None and trend.remaining_p90 is not None:
        low, middle, high = (round(n) for n in (trend.remaining_p10, trend.remaining_p50, trend.remaining_p90))
        parts.append(say("limit in {middle} strokes ({low} to {high})", low=low, middle=middle, high=high))
    elif trend.limit_mm is not None:
        parts.append(say("no forecast yet"))
    return " · ".join(parts)
