"""The demo's screen is legible on narrow and wide terminals, with and without colours."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from wearline.demo.screen import Picture, draw, line, sparkline, summary_lines
from wearline.demo.tally import Row, Summary
from wearline.messages import Decision, WearTrend

ROWS = (
    Row("a", 1, Decision.PASSED, "", 0.0, -0.031, 0.0, 62.0, 1),
    Row("b", 2, Decision.FAILED, "", 0.121, -0.254, 0.19, 70.0, 2),
    Row("c", 3, Decision.NOT_MEASURED, "no verdict before the deadline", None, None, None, 2501.0, 10),
)
TREND = WearTrend(
    object_index=1, points=((1, 0.0), (2, 0.1), (3, 0.2)), wear_mm=0.2, slope_mm_per_kilostroke=4.1, slope_sigma=0.1,
    limit_mm=0.25, remaining_p10=2.0, remaining_p50=5.0, remaining_p90=9.0, strokes_since_service=3,
)  # fmt: skip


def shown(width: int, picture: Picture) -> str:
    out = io.StringIO()
    Console(file=out, width=width, no_color=True).print(draw(picture, width, 30))
    return out.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_every_width_shows_verdicts_by_word_and_shape_and_no_line_is_cut(width: int) -> None:
    services = {name: name != "judge" for name in ("capture", "reconstruct", "judge", "fieldbus", "hmi")}
    text = shown(width, Picture("http://127.0.0.1:8448/", services, True, ROWS, TREND, 0.1, "die reground", 200))
    assert max(len(row) for row in text.splitlines()) <= width
    for word in ("✔ PASSED", "✘ FAILED", "– NOT MEASURED", "○ judge", "● capture", "0.121", "-0.254", "127.0.0.1:8448",
                 "stroke 3 of 200", "left 5 (2–9)"):  # fmt: skip
        assert word in " ".join(text.split()), word


def test_a_wide_terminal_shows_the_wear_of_each_stroke() -> None:
    assert "0.190" in shown(120, Picture("x", rows=ROWS, limit_mm=0.1))
    assert "0.190" not in shown(80, Picture("x", rows=ROWS, limit_mm=0.1))


def test_what_is_not_known_is_said_so() -> None:
    text = shown(100, Picture("x", {"judge": False}))
    assert "no wear trend yet" in text
    assert "PLC no link" in text
    unknown = TREND.replace(remaining_p10=None, remaining_p50=None, remaining_p90=None, slope_mm_per_kilostroke=None)
    assert "not identifiable yet" in shown(120, Picture("x", trend=unknown))


def test_a_sparkline_keeps_the_newest_and_scales_to_the_largest() -> None:
    assert sparkline([0.0, 0.5, 1.0], 2) == "▅█"
    assert sparkline([0.0, 0.0], 5) == "▁▁"
    assert sparkline([], 5) == ""


def test_a_line_of_the_log_says_why_a_part_was_not_measured() -> None:
    assert "no verdict before the deadline" in line(ROWS[2])
    assert " ".join(line(ROWS[1]).split()) == "stroke 2 FAILED mean 0.121 mm max -0.254 mm wear 0.190 mm 70 ms"


def test_a_summary_says_plainly_what_went_wrong() -> None:
    good = Summary(2, dict.fromkeys(Decision, 0), 2, 2, (), (), 2, 2, 2, 2, 80.0, 90.0)
    assert summary_lines(good, 10, 5.0)[-1] == "as promised"
    bad = Summary(2, dict.fromkeys(Decision, 0), 2, 1, (2,), (2,), None, 2, 2, 2, 80.0, 90.0)
    assert summary_lines(bad, 10, 5.0)[-1] == "NOT as promised"
    assert "FALSE PASSED at strokes 2" in summary_lines(bad, 10, 5.0)
