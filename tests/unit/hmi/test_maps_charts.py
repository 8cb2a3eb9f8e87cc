"""Maps and charts on their way to the browser."""

from __future__ import annotations

import numpy as np
import pytest

from tests.contract.examples import CYCLE, TREND
from wearline import messages as m
from wearline_hmi.core.charts import INKS, forecast_of, trend_chart, trend_sentence
from wearline_hmi.core.language import ENGLISH, LANGUAGES
from wearline_hmi.core.maps import nice_above, view_bytes, view_header

NAMES = ("standard", "measured", "difference", "error")


def view(maps: np.ndarray, mm_per_pixel: float | None = 0.1) -> m.View:
    return m.View(**CYCLE, maps_mm=maps.astype(np.float32), step_px=4.0, origin_px=(0, 0), mm_per_pixel=mm_per_pixel)


def test_bytes_are_little_endian_floats_and_nan_stays_nan() -> None:
    maps = np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    maps[1, 0, 2] = np.nan
    back = np.frombuffer(view_bytes(view(maps)), "<f4").reshape(4, 2, 3)
    np.testing.assert_array_equal(back, maps)


def test_a_header_has_one_scale_for_standard_and_measured_and_the_share_that_was_measured() -> None:
    maps = np.zeros((4, 10, 20))
    maps[0] = np.linspace(0, 8, 200).reshape(10, 20)
    maps[1] = maps[0] + 0.2
    maps[1, :, :5] = np.nan
    maps[2] = 0.2
    header = view_header(view(maps))
    assert header.names == NAMES
    assert (header.rows, header.cols, header.unit) == (10, 20, "mm")
    assert header.step == pytest.approx(0.4)
    assert header.scales[0] == header.scales[1]
    assert header.measured_share == pytest.approx(0.75)
    assert (header.scales[2].low_mm, header.scales[2].high_mm) == (-0.2, 0.2)
    assert header.scales[3].low_mm == 0.0
    assert header.scales[3].high_mm == pytest.approx(0.1), "noise must not look like wear"


def test_a_map_without_any_point_still_has_a_scale() -> None:
    header = view_header(view(np.full((4, 5, 5), np.nan), None))
    assert header.unit == "px"
    assert header.measured_share == 0.0
    assert all(np.isfinite([x.low_mm, x.high_mm, x.relief]).all() and x.high_mm > x.low_mm for x in header.scales)


@pytest.mark.parametrize(
    ("value", "wanted"), [(0.1, 0.1), (0.11, 0.2), (0.21, 0.5), (0.51, 1.0), (1.0, 1.0), (70, 100)]
)
def test_nice_numbers(value: float, wanted: float) -> None:
    assert nice_above(value) == pytest.approx(wanted)


FULL = TREND.replace(
    points=tuple((n, 0.001 * n) for n in range(1, 51)), wear_mm=0.05, limit_mm=0.1, remaining_p10=40.0,
    remaining_p50=50.0, remaining_p90=80.0,
)  # fmt: skip


def test_the_forecast_meets_the_limit_at_its_quantiles() -> None:
    forecast = forecast_of(FULL)
    assert forecast is not None
    assert forecast.strokes[0] == 50
    assert forecast.strokes[-1] == 130
    assert forecast.low_mm[0] == forecast.high_mm[0] == pytest.approx(0.05)
    assert forecast.low_mm[-1] == pytest.approx(0.1)
    middle = np.interp(50 + 25, forecast.strokes, forecast.middle_mm)
    assert middle == pytest.approx(0.075, abs=0.003)
    assert all(a <= b <= c for a, b, c in zip(forecast.low_mm, forecast.middle_mm, forecast.high_mm, strict=True))


@pytest.mark.parametrize(
    "change",
    [
        {"remaining_p50": None},
        {"limit_mm": None},
        {"points": ()},
        {"wear_mm": 0.2},
        {"wear_mm": None},
        {"remaining_p10": 0.0},
    ],
)
def test_there_is_no_forecast_where_it_is_not_identifiable(change: dict[str, object]) -> None:
    trend = FULL.replace(**change)
    assert forecast_of(trend) is None
    assert "forecast" not in {str(x["name"]) for x in trend_chart(trend, INKS["light"], ENGLISH)["series"]}


def test_the_chart_shows_limit_die_events_and_forecast() -> None:
    chart = trend_chart(FULL, INKS["light"], ENGLISH)
    wear = chart["series"][0]
    marks = wear["markLine"]["data"]
    assert {"yAxis", "xAxis"} <= {key for mark in marks for key in mark}
    assert wear["data"][-1] == [50, 0.05]
    assert [x["name"] for x in chart["series"]] == ["wear", "low", "80 % of the forecasts", "forecast"]
    assert chart["yAxis"]["max"] > 0.1


def test_the_trend_in_words() -> None:
    assert trend_sentence(None, ENGLISH) == "No wear trend yet"
    text = trend_sentence(FULL, ENGLISH)
    assert "limit in 50 strokes (40 to 80)" in text
    assert "no forecast yet" in trend_sentence(FULL.replace(remaining_p50=None), ENGLISH)
    assert "0,050" in trend_sentence(FULL, LANGUAGES["de"])
