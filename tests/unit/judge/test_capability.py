"""Studies of the gauge against published examples and exact algebra, and their reports."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from wearline_judge.core.capability import (
    Capability,
    Study,
    StudyError,
    flatness,
    linearity,
    stability,
    step,
    step_height,
    type_1,
    type_3,
)
from wearline_judge.drivers.reports import ReportHead, html_report, pdf_report

AIAG_REFERENCES = (2.0, 4.0, 6.0, 8.0, 10.0)
AIAG_READINGS = (
    (2.7, 2.5, 2.4, 2.5, 2.7, 2.3, 2.5, 2.5, 2.4, 2.4, 2.6, 2.4),
    (5.1, 3.9, 4.2, 5.0, 3.8, 3.9, 3.9, 3.9, 3.9, 4.0, 4.1, 3.8),
    (5.8, 5.7, 5.9, 5.9, 6.0, 6.1, 6.0, 6.1, 6.4, 6.3, 6.0, 6.1),
    (7.6, 7.7, 7.8, 7.7, 7.8, 7.8, 7.8, 7.7, 7.8, 7.5, 7.6, 7.7),
    (9.1, 9.3, 9.5, 9.3, 9.4, 9.5, 9.5, 9.5, 9.6, 9.2, 9.3, 9.4),
)
"""AIAG Measurement Systems Analysis, 4th edition, chapter III B, linearity: the manual's own worked example."""


def figure(study: Study, name: str) -> float:
    return next(f.value for f in study.figures if f.name == name)


def normalised(seed: int, count: int, mean: float, sigma: float) -> np.ndarray:
    """Values with exactly this mean and standard deviation."""
    x = np.random.default_rng(seed).standard_normal(count)
    return np.asarray(mean + sigma * (x - x.mean()) / x.std(ddof=1))


def test_linearity_is_that_of_the_manual() -> None:
    study = linearity(AIAG_REFERENCES, AIAG_READINGS, 10.0)
    assert figure(study, "slope of the bias") == pytest.approx(-0.131667, abs=1e-6)
    assert figure(study, "bias at zero") == pytest.approx(0.736667, abs=1e-6)
    assert figure(study, "R squared") == pytest.approx(0.714, abs=5e-4)
    assert abs(figure(study, "t of the slope")) == pytest.approx(12.043, abs=2e-3)
    assert figure(study, "t of the bias at zero") == pytest.approx(10.158, abs=2e-3)
    assert figure(study, "standard deviation about the line") == pytest.approx(0.23954, abs=1e-5)
    assert study.outcome is Capability.NOT_CAPABLE
    assert linearity(AIAG_REFERENCES, AIAG_READINGS, 20.0).outcome is Capability.CAPABLE


@pytest.mark.parametrize(
    ("mean", "sigma", "cg", "cgk", "outcome"),
    [
        (6.0, 0.001, 2.0, 2.0, Capability.CAPABLE),
        (6.002, 0.001, 2.0, 4.0 / 3.0, Capability.CAPABLE),
        (5.997, 0.001, 2.0, 1.0, Capability.NOT_CAPABLE),
        (6.0, 0.0016, 1.25, 1.25, Capability.NOT_CAPABLE),
    ],
)
def test_type_1_algebra(mean: float, sigma: float, cg: float, cgk: float, outcome: Capability) -> None:
    study = type_1(normalised(1, 50, mean, sigma).tolist(), 6.0, 0.06)
    assert figure(study, "Cg") == pytest.approx(cg)
    assert figure(study, "Cgk") == pytest.approx(cgk)
    assert study.outcome is outcome
    # At the smallest tolerances the figures are exactly the limit.
    for name in ("Cg", "Cgk"):
        again = type_1(normalised(1, 50, mean, sigma).tolist(), 6.0, figure(study, f"smallest tolerance for {name}"))
        assert figure(again, name) == pytest.approx(1.33)


def parts_of(seed: int, parts: int, runs: int, part_sigma: float, sigma: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(10.0, part_sigma, (parts, 1)) + rng.normal(0.0, sigma, (parts, runs))


def test_type_3_of_two_runs_is_exact() -> None:
    # Two runs that differ by +-d: the variance within is d^2 / 2, and the means carry the parts alone.
    means = normalised(2, 25, 10.0, 0.1)
    d = np.where(np.arange(25) % 2, 0.01, -0.01)
    study = type_3(np.column_stack([means - d / 2, means + d / 2]).tolist(), 0.5)
    grr = 0.01 / np.sqrt(2.0)
    parts = np.sqrt(0.1**2 - grr**2 / 2.0)
    assert figure(study, "GRR (repeatability)") == pytest.approx(grr)
    assert figure(study, "PV (parts)") == pytest.approx(parts)
    assert figure(study, "%GRR of the tolerance") == pytest.approx(600.0 * grr / 0.5)
    assert figure(study, "ndc") == int(1.41 * parts / grr)
    assert study.outcome is Capability.CAPABLE


@pytest.mark.parametrize(
    ("sigma", "outcome"),
    [(0.005, Capability.CAPABLE), (0.015, Capability.CONDITIONAL), (0.06, Capability.NOT_CAPABLE)],
)
def test_type_3_outcomes(sigma: float, outcome: Capability) -> None:
    assert type_3(parts_of(3, 25, 2, 0.15, sigma).tolist(), 0.5).outcome is outcome


def test_type_3_finds_the_true_variances() -> None:
    found = [type_3(parts_of(s, 40, 3, 0.1, 0.02).tolist(), 1.0) for s in range(60)]
    grr2 = np.mean([figure(f, "GRR (repeatability)") ** 2 for f in found])
    pv2 = np.mean([figure(f, "PV (parts)") ** 2 for f in found])
    assert grr2 == pytest.approx(0.02**2, rel=0.05)
    assert pv2 == pytest.approx(0.1**2, rel=0.08)


def test_parts_that_are_all_alike_are_told() -> None:
    study = type_3(parts_of(4, 25, 2, 0.003, 0.005).tolist(), 0.5)
    assert study.outcome is Capability.CONDITIONAL and "ndc" in study.notes[0]


def test_stability_chart() -> None:
    steady = normalised(5, 60, 5.0, 0.004)
    assert stability(steady.tolist(), 5.0, 0.1).outcome is Capability.CAPABLE
    drifting = steady + np.linspace(0.0, 0.03, 60)
    study = stability(drifting.tolist(), 5.0, 1.0)
    assert study.outcome is Capability.NOT_CAPABLE and "left its limits" in study.sentence
    off = stability((steady + 0.02).tolist(), 5.0, 0.1)
    assert off.outcome is Capability.NOT_CAPABLE and "off by +0.02" in off.sentence


def plate(seed: int, bend_mm: float, tilt: float, sigma: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-40.0, 40.0, (2, 3000))
    r2 = (x / 40.0) ** 2
    z = tilt * x - 0.5 * tilt * y + bend_mm * r2 + rng.normal(0.0, sigma, x.size)
    return np.column_stack([x, y, z])


def test_flatness_measures_form_and_not_tilt() -> None:
    flat = [plate(k, 0.0, 0.02 * k, 0.001) for k in range(6)]
    bent = [*flat[:5], plate(9, 0.05, 0.1, 0.001)]
    good, bad = flatness(flat, 0.02), flatness(bent, 0.02)
    assert good.outcome is Capability.CAPABLE and figure(good, "F, worst position") < 0.009
    assert bad.outcome is Capability.NOT_CAPABLE and "position 6" in bad.sentence
    assert figure(bad, "F, worst position") == pytest.approx(0.05, abs=0.008)
    # Three in a thousand may be left out, five may not.
    for wild, outcome in ((9, Capability.CAPABLE), (15, Capability.NOT_CAPABLE)):
        spoiled = flat[0].copy()
        spoiled[:wild, 2] += 0.5
        assert flatness([spoiled, *flat[1:]], 0.02).outcome is outcome


def faces(height: float, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """A step turned as a whole about y by `tilt` rad; exact."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-20.0, -2.0, 20), np.linspace(-10.0, 10.0, 20)))
    turned = np.array([[np.cos(tilt), 0.0, np.sin(tilt)], [0.0, 1.0, 0.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
    low = np.column_stack([x, y, np.zeros_like(x)]) @ turned.T
    high = np.column_stack([x + 22.0, y, np.full_like(x, height)]) @ turned.T
    return low, high


def test_step_height_is_exact_however_it_lies() -> None:
    for tilt in (0.0, 0.1, -0.3):
        assert step_height(*faces(3.0, tilt)) == pytest.approx(3.0, abs=1e-9)
    positions = [faces(3.0 + 0.004 * k, 0.05 * k) for k in range(6)]
    study = step(positions, 3.0, 0.01)
    assert figure(study, "error, worst position") == pytest.approx(0.02)
    assert study.outcome is Capability.NOT_CAPABLE
    assert step(positions, 3.0, 0.021).outcome is Capability.CAPABLE


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: type_1([1.0] * 24, 1.0, 0.1), "24 repeats are too few"),
        (lambda: type_1([1.0] * 30, 1.0, 0.1), "all repeats are equal"),
        (lambda: type_1([float("nan")] * 30, 1.0, 0.1), "no numbers"),
        (lambda: type_1(list(range(30)), 1.0, 0.0), "tolerance"),
        (lambda: type_3([[1.0, 2.0]] * 10, 1.0), "10 parts are too few"),
        (lambda: type_3([[1.0, 2.0], [1.0]], 1.0), "same two or more runs"),
        (lambda: linearity([1.0, 2.0], [[1.0, 1.1], [2.0, 2.1]], 1.0), "fewer than three"),
        (lambda: stability([1.0, 2.0], 1.0, 0.1), "too few"),
        (lambda: flatness([plate(1, 0, 0, 0.001)], 0.1), "1 positions are too few"),
        (lambda: step([(np.zeros((5, 3)), np.zeros((5, 3)))] * 6, 1.0, 0.1), "5 points are too few"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(make: Callable[[], Study], text: str) -> None:
    with pytest.raises(StudyError, match=text) as caught:
        make()
    assert "\n" not in str(caught.value) and ";" in str(caught.value)


HEAD = ReportHead("P1", "head <3>", "tray & lid", "2026-01-01T00:00:00+00:00", "Ada", "ab" * 32, "cd" * 32, "0.1", True)


def studies() -> list[Study]:
    return [
        type_1(normalised(1, 50, 6.0, 0.001).tolist(), 6.0, 0.06),
        type_3(parts_of(3, 25, 2, 0.15, 0.015).tolist(), 0.5),
        linearity(AIAG_REFERENCES, AIAG_READINGS, 10.0),
        stability(normalised(5, 60, 5.0, 0.004).tolist(), 5.0, 0.1),
        flatness([plate(k, 0.0, 0.02 * k, 0.001) for k in range(6)], 0.02),
        step([faces(3.0, 0.05 * k) for k in range(6)], 3.0, 0.01),
    ]


def test_reports_show_every_figure() -> None:
    page = html_report(HEAD, studies())
    assert "head &lt;3&gt;" in page and "tray &amp; lid" in page and "Simulated" in page
    assert page.count("<svg") == 6 and "http" not in page
    for study in studies():
        assert study.title in page
        for entry in study.figures:
            assert entry.name in page
    pdf = pdf_report(HEAD, studies())
    assert pdf.startswith(b"%PDF-") and len(pdf) > 5000
    assert pdf == pdf_report(HEAD, studies())
    real = ReportHead("P1", "h", "o", "2026-01-01T00:00:00+00:00")
    assert "Simulated" not in html_report(real, studies())
