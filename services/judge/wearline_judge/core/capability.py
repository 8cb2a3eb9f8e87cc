"""Whether the gauge itself is good enough: studies of repeatability, of parts, of linearity, of stability, and form.

Type 1 and 3 and the linearity study follow AIAG MSA (4th edition) and VDA 5; flatness and step are
in the style of VDI/VDE 2634-2, with plates and steps as artefacts, and do not claim all its clauses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wearline.config import Settings
from wearline.errors import WearlineError
from wearline_judge.core.charts import individuals, nelson
from wearline_judge.core.line_grid import F64


class StudyError(WearlineError):
    """Measurements from which a study cannot be made."""


class Capability(StrEnum):
    """Outcome of a study."""

    CAPABLE = "capable"
    CONDITIONAL = "conditionally capable"
    NOT_CAPABLE = "not capable"


class CapabilitySettings(Settings):
    """Limits of the studies."""

    cg_min: float = Field(default=1.33, gt=0)
    """For Cg and Cgk."""
    repeats_min: int = Field(default=25, ge=2)
    """Of a type 1 study."""
    parts_min: int = Field(default=25, ge=2)
    """Of a type 3 study."""
    grr_good: float = Field(default=10.0, gt=0)
    """%GRR below which a gauge is capable. [%]"""
    grr_poor: float = Field(default=30.0, gt=0)
    """%GRR above which it is not. [%]"""
    ndc_min: int = Field(default=5, ge=1)
    """Classes of parts that a gauge should tell apart."""
    linearity_max: float = Field(default=5.0, gt=0)
    """Largest bias over the range, as a share of the tolerance. [%]"""
    stability_base: int = Field(default=20, ge=5)
    """First measurements of the master part, from which the chart's limits are taken."""
    positions_min: int = Field(default=6, ge=1)
    """Positions of an artefact in the measuring volume."""
    discarded: float = Field(default=0.003, ge=0, lt=0.5)
    """Share of points that a form study may leave out (VDI/VDE 2634-2: three in a thousand)."""


@dataclass(frozen=True)
class Figure:
    """One line of a study's table."""

    name: str
    value: float
    unit: str = ""
    condition: str = ""
    """What is asked of it, in words; empty = nothing."""
    is_met: bool | None = None


@dataclass(frozen=True)
class Chart:
    """What a study's picture shows."""

    x_name: str
    y_name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    levels: tuple[tuple[str, float], ...] = ()
    """Horizontal lines: name and height."""
    is_joined: bool = True
    fitted: tuple[tuple[float, float], ...] = ()
    """Two ends of a line through the points; empty = none."""


@dataclass(frozen=True)
class Study:
    """Result of one study."""

    kind: Literal["type 1", "type 3", "linearity", "stability", "flatness", "step"]
    title: str
    outcome: Capability
    sentence: str
    figures: tuple[Figure, ...]
    chart: Chart
    notes: tuple[str, ...] = field(default=())


def _need(condition: bool, what: str, cure: str) -> None:
    if not condition:
        raise StudyError(what, "capability study", cure)


def _values(values: Sequence[float], name: str) -> F64:
    found = np.asarray(values, np.float64)
    _need(found.ndim == 1 and bool(np.isfinite(found).all()), f"{name} holds values that are no numbers", "drop them")
    return found


def type_1(
    values_mm: Sequence[float], reference_mm: float, tolerance_mm: float, settings: CapabilitySettings | None = None
) -> Study:
    """Repeats on one reference: Cg = 0.2 T / 6 s, Cgk = (0.1 T - |bias|) / 3 s.

    Args:
        values_mm: repeats without change of setting. [mm]
        reference_mm: what the artefact measures truly. [mm]
        tolerance_mm: width of the part's tolerance. [mm]
        settings: limits.

    Raises:
        StudyError: too few repeats, no tolerance, or values that are no numbers.
    """
    settings = settings or CapabilitySettings()
    x = _values(values_mm, "the list of repeats")
    _need(x.size >= settings.repeats_min, f"{x.size} repeats are too few", f"take {settings.repeats_min} or more")
    _need(tolerance_mm > 0, "the tolerance must be positive", "enter its width in mm")
    bias, sigma = float(np.mean(x)) - reference_mm, float(np.std(x, ddof=1))
    # Readings that never differ say that the gauge does not resolve, not that it is perfect.
    _need(sigma > 0, "all repeats are equal, so nothing can be said of their scatter", "record more digits")
    cg, cgk = 0.2 * tolerance_mm / (6.0 * sigma), (0.1 * tolerance_mm - abs(bias)) / (3.0 * sigma)
    score = bias / (sigma / float(np.sqrt(x.size)))
    least = settings.cg_min
    outcome = Capability.CAPABLE if cg >= least and cgk >= least else Capability.NOT_CAPABLE
    why = "" if outcome is Capability.CAPABLE else (": it scatters" if cg < least else ": its bias is too large")
    return Study(
        "type 1", "Type 1 study: repeats on a reference", outcome,
        f"the gauge is {outcome.value}{why} (Cg {cg:.2f}, Cgk {cgk:.2f}, {least:g} needed)",
        (
            Figure("repeats", float(x.size)),
            Figure("reference", reference_mm, "mm"),
            Figure("mean", float(np.mean(x)), "mm"),
            Figure("bias", bias, "mm"),
            Figure("standard deviation", sigma, "mm"),
            Figure("t of the bias", score),
            Figure("Cg", cg, "", f"at least {least:g}", cg >= least),
            Figure("Cgk", cgk, "", f"at least {least:g}", cgk >= least),
            # The smallest tolerance that this gauge may judge.
            Figure("smallest tolerance for Cg", 30.0 * sigma * least, "mm"),
            Figure("smallest tolerance for Cgk", 10.0 * (abs(bias) + 3.0 * least * sigma), "mm"),
        ),
        Chart(
            "repeat", "measured [mm]", tuple(float(i) for i in range(1, x.size + 1)), tuple(x.tolist()),
            (("reference", reference_mm), ("+0.1 T", reference_mm + 0.1 * tolerance_mm),
             ("-0.1 T", reference_mm - 0.1 * tolerance_mm)),
        ),
    )  # fmt: skip


def type_3(
    runs_mm: Sequence[Sequence[float]], tolerance_mm: float, settings: CapabilitySettings | None = None
) -> Study:
    """Parts measured twice or more without any influence of a person: %GRR and ndc by one-way analysis of variance.

    Args:
        runs_mm: one row per part, one value per run. [mm]
        tolerance_mm: width of the part's tolerance. [mm]
        settings: limits.

    Raises:
        StudyError: too few parts or runs, rows of different length, no tolerance, no scatter.
    """
    settings = settings or CapabilitySettings()
    lengths = {len(row) for row in runs_mm}
    _need(len(lengths) == 1 and min(lengths) >= 2, "every part needs the same two or more runs", "complete the table")
    table = np.asarray(runs_mm, np.float64)
    parts, runs = table.shape
    _need(bool(np.isfinite(table).all()), "the table holds values that are no numbers", "measure those parts again")
    _need(parts >= settings.parts_min, f"{parts} parts are too few", f"take {settings.parts_min} or more")
    _need(tolerance_mm > 0, "the tolerance must be positive", "enter its width in mm")
    means = table.mean(axis=1)
    within = float(np.sum((table - means[:, None]) ** 2)) / (parts * (runs - 1))
    between = runs * float(np.sum((means - table.mean()) ** 2)) / (parts - 1)
    _need(within > 0, "the runs are equal, so nothing can be said of their scatter", "record more digits")
    grr = float(np.sqrt(within))
    part_sigma = float(np.sqrt(max((between - within) / runs, 0.0)))
    total = float(np.hypot(grr, part_sigma))
    share = 600.0 * grr / tolerance_mm
    ndc = int(1.41 * part_sigma / grr)
    if share <= settings.grr_good:
        outcome = Capability.CAPABLE
    else:
        outcome = Capability.CONDITIONAL if share <= settings.grr_poor else Capability.NOT_CAPABLE
    notes: tuple[str, ...] = ()
    if ndc < settings.ndc_min:
        notes = (
            f"the parts differ by little (ndc {ndc}): take parts that fill the tolerance, or the gauge tells too few "
            "classes apart",
        )
        if outcome is Capability.CAPABLE:
            outcome = Capability.CONDITIONAL
    return Study(
        "type 3", "Type 3 study: parts measured repeatedly without a person", outcome,
        f"the gauge is {outcome.value} (%GRR {share:.1f} % of the tolerance, ndc {ndc})",
        (
            Figure("parts", float(parts)),
            Figure("runs", float(runs)),
            Figure("GRR (repeatability)", grr, "mm"),
            Figure("PV (parts)", part_sigma, "mm"),
            Figure("TV (total)", total, "mm"),
            Figure(
                "%GRR of the tolerance", share, "%", f"at most {settings.grr_good:g} %, conditionally "
                f"{settings.grr_poor:g} %", share <= settings.grr_poor,
            ),
            Figure("%GRR of the total", 100.0 * grr / total, "%"),
            Figure("ndc", float(ndc), "", f"at least {settings.ndc_min}", ndc >= settings.ndc_min),
        ),
        Chart(
            "part", "difference of runs from their mean [mm]",
            tuple(float(i) for i in np.repeat(np.arange(1, parts + 1), runs)),
            tuple((table - means[:, None]).ravel().tolist()), (("3 s", 3.0 * grr), ("-3 s", -3.0 * grr)), False,
        ),
        notes,
    )  # fmt: skip


def linearity(
    references_mm: Sequence[float], runs_mm: Sequence[Sequence[float]], tolerance_mm: float,
    settings: CapabilitySettings | None = None,
) -> Study:  # fmt: skip
    """Bias over the measuring range: a line through the biases at several references.

    Args:
        references_mm: true values of five or so artefacts over the range. [mm]
        runs_mm: readings of each. [mm]
        tolerance_mm: width of the part's tolerance. [mm]
        settings: limits.

    Raises:
        StudyError: fewer than three different references or two readings of each, no tolerance.
    """
    settings = settings or CapabilitySettings()
    reference = _values(references_mm, "the list of references")
    _need(len(runs_mm) == reference.size, "every reference needs its readings", "complete the table")
    _need(np.unique(reference).size >= 3, "fewer than three references span no range", "take five over the range")
    _need(min(len(r) for r in runs_mm) >= 2, "every reference needs two readings or more", "measure again")
    _need(tolerance_mm > 0, "the tolerance must be positive", "enter its width in mm")
    x = np.concatenate([np.full(len(r), v) for v, r in zip(reference, runs_mm, strict=True)])
    bias = np.concatenate([_values(r, "a list of readings") for r in runs_mm]) - x
    spread = float(np.sum((x - x.mean()) ** 2))
    slope = float(np.sum((x - x.mean()) * bias)) / spread
    offset = float(np.mean(bias)) - slope * float(np.mean(x))
    rest = bias - offset - slope * x
    sigma = float(np.sqrt(np.sum(rest**2) / (x.size - 2)))
    _need(sigma > 0, "all readings lie on one line, so nothing can be said of their scatter", "record more digits")
    total = float(np.sum((bias - bias.mean()) ** 2))
    slope_score = slope / (sigma / float(np.sqrt(spread)))
    offset_score = offset / (sigma * float(np.sqrt(1.0 / x.size + np.mean(x) ** 2 / spread)))
    ends = np.array([reference.min(), reference.max()])
    worst = float(np.max(np.abs(offset + slope * ends)))
    share = 100.0 * worst / tolerance_mm
    is_met = share <= settings.linearity_max
    outcome = Capability.CAPABLE if is_met else Capability.NOT_CAPABLE
    return Study(
        "linearity", "Linearity study: bias over the measuring range", outcome,
        f"the gauge is {outcome.value} (bias up to {worst:.4f} mm over the range, {share:.1f} % of the tolerance)",
        (
            Figure("slope of the bias", slope, "mm/mm"),
            Figure("bias at zero", offset, "mm"),
            Figure("R squared", 1.0 - float(np.sum(rest**2)) / total if total > 0 else 0.0),
            Figure("standard deviation about the line", sigma, "mm"),
            Figure("t of the slope", slope_score),
            Figure("t of the bias at zero", offset_score),
            Figure("largest bias", worst, "mm"),
            Figure("of the tolerance", share, "%", f"at most {settings.linearity_max:g} %", is_met),
        ),
        Chart(
            "reference [mm]", "bias [mm]", tuple(x.tolist()), tuple(bias.tolist()), (("no bias", 0.0),), False,
            tuple((float(e), offset + slope * float(e)) for e in ends),
        ),
    )  # fmt: skip


def stability(
    values_mm: Sequence[float], reference_mm: float, tolerance_mm: float, settings: CapabilitySettings | None = None
) -> Study:
    """A master part measured now and then: an individuals chart whose limits come from its first measurements.

    Args:
        values_mm: in the order of time. [mm]
        reference_mm: true value of the master part. [mm]
        tolerance_mm: width of the part's tolerance. [mm]
        settings: limits.

    Raises:
        StudyError: too few measurements, no scatter, no tolerance.
    """
    settings = settings or CapabilitySettings()
    x = _values(values_mm, "the master part's record")
    base = settings.stability_base
    _need(x.size >= base, f"{x.size} measurements of the master part are too few", f"go on until there are {base}")
    _need(tolerance_mm > 0, "the tolerance must be positive", "enter its width in mm")
    limits, _ = individuals(x[:base])
    sigma = (limits.upper - limits.centre) / 3.0
    _need(sigma > 0, "the first measurements are equal", "record more digits")
    breaks = nelson(x - limits.centre, sigma, rules=(1, 2))
    first = min((b.index for b in breaks), default=None)
    bias = float(np.mean(x[-base:])) - reference_mm
    allowed = 0.1 * tolerance_mm
    is_steady, is_true = first is None, abs(bias) <= allowed
    outcome = Capability.CAPABLE if is_steady and is_true else Capability.NOT_CAPABLE
    if not is_steady:
        why = f": it left its limits at measurement {(first or 0) + 1}"
    else:
        why = "" if is_true else f": it is off by {bias:+.4f} mm"
    return Study(
        "stability", "Stability with a master part", outcome, f"the gauge is {outcome.value}{why}",
        (
            Figure("measurements", float(x.size)),
            Figure("centre", limits.centre, "mm"),
            Figure("upper limit", limits.upper, "mm"),
            Figure("lower limit", limits.lower, "mm"),
            Figure("signals (Nelson 1 and 2)", float(len(breaks)), "", "none", is_steady),
            Figure("bias of the newest", bias, "mm", f"within {allowed:.4g} mm", is_true),
        ),
        Chart(
            "measurement", "master part [mm]", tuple(float(i) for i in range(1, x.size + 1)), tuple(x.tolist()),
            (("upper", limits.upper), ("centre", limits.centre), ("lower", limits.lower)),
        ),
    )  # fmt: skip


def _plane(points: F64) -> tuple[F64, F64]:
    """Centre and unit normal of the least-squares plane (orthogonal distances) through points [n, 3]."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    return centre, normal if normal[2] >= 0 else -normal


def _cloud(points: NDArray[np.floating], least: int) -> F64:
    found = np.asarray(points, np.float64)
    _need(found.ndim == 2 and found.shape[1:] == (3,), "points are x, y, z", "give an array [n, 3] in mm")
    found = found[np.isfinite(found).all(axis=1)]
    _need(len(found) >= least, f"{len(found)} points are too few for a plane", "look at the frame")
    return found


def _kept(residual: F64, share: float) -> F64:
    """Residuals less the share that may be left out, the largest first."""
    drop = int(share * residual.size)
    return residual[np.argsort(np.abs(residual), kind="stable")[: residual.size - drop]]


def flatness(
    positions: Sequence[NDArray[np.floating]], limit_mm: float, settings: CapabilitySettings | None = None
) -> Study:
    """A flat plate at several positions: F = range of the distances from its least-squares plane.

    Args:
        positions: points [n, 3] (x, y, z) of the plate at each. [mm]
        limit_mm: largest F allowed. [mm]
        settings: number of positions, share of points left out.

    Raises:
        StudyError: too few positions or points.
    """
    settings = settings or CapabilitySettings()
    _need(len(positions) >= settings.positions_min, f"{len(positions)} positions are too few",
          f"take {settings.positions_min} over the measuring volume")  # fmt: skip
    ranges, spreads = [], []
    for points in positions:
        cloud = _cloud(points, 100)
        centre, normal = _plane(cloud)
        residual = (cloud - centre) @ normal
        ranges.append(float(np.ptp(_kept(residual, settings.discarded))))
        spreads.append(float(np.std(residual)))
    worst = max(ranges)
    is_met = worst <= limit_mm
    outcome = Capability.CAPABLE if is_met else Capability.NOT_CAPABLE
    return Study(
        "flatness", "Flatness, in the style of VDI/VDE 2634-2", outcome,
        f"the gauge is {outcome.value} (F {worst:.4f} mm at position {ranges.index(worst) + 1}, "
        f"{limit_mm:g} mm allowed)",
        (
            Figure("positions", float(len(positions))),
            Figure("F, worst position", worst, "mm", f"at most {limit_mm:g} mm", is_met),
            Figure("F, median", float(np.median(ranges)), "mm"),
            Figure("standard deviation, median", float(np.median(spreads)), "mm"),
        ),
        Chart(
            "position", "F [mm]", tuple(float(i) for i in range(1, len(ranges) + 1)), tuple(ranges),
            (("allowed", limit_mm),), False,
        ),
    )  # fmt: skip


def step_height(low: NDArray[np.floating], high: NDArray[np.floating]) -> float:
    """Height of a step: distance of two parallel least-squares planes with one common normal. [mm]

    Args:
        low, high: points [n, 3] of the two faces. [mm]
    """
    below, above = _cloud(low, 30), _cloud(high, 30)
    joint = np.concatenate([below - below.mean(axis=0), above - above.mean(axis=0)])
    normal = np.linalg.svd(joint, full_matrices=False)[2][2]
    normal = normal if normal[2] >= 0 else -normal
    return float((above.mean(axis=0) - below.mean(axis=0)) @ normal)


def step(
    positions: Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]], calibrated_mm: float, limit_mm: float,
    settings: CapabilitySettings | None = None,
) -> Study:  # fmt: skip
    """A calibrated step at several positions: measured minus calibrated height, as sphere spacing is judged.

    Args:
        positions: points [n, 3] of the low and the high face at each. [mm]
        calibrated_mm: true height. [mm]
        limit_mm: largest error allowed, either way. [mm]
        settings: number of positions.

    Raises:
        StudyError: too few positions or points.
    """
    settings = settings or CapabilitySettings()
    _need(len(positions) >= settings.positions_min, f"{len(positions)} positions are too few",
          f"take {settings.positions_min} over the measuring volume")  # fmt: skip
    errors = [step_height(low, high) - calibrated_mm for low, high in positions]
    worst = max(errors, key=abs)
    is_met = abs(worst) <= limit_mm
    outcome = Capability.CAPABLE if is_met else Capability.NOT_CAPABLE
    return Study(
        "step", "Step height, in the style of VDI/VDE 2634-2", outcome,
        f"the gauge is {outcome.value} (error {worst:+.4f} mm at position {errors.index(worst) + 1}, "
        f"{limit_mm:g} mm allowed)",
        (
            Figure("positions", float(len(positions))),
            Figure("calibrated height", calibrated_mm, "mm"),
            Figure("error, worst position", worst, "mm", f"within {limit_mm:g} mm", is_met),
            Figure("error, mean", float(np.mean(errors)), "mm"),
            Figure("error, standard deviation", float(np.std(errors, ddof=1)) if len(errors) > 1 else 0.0, "mm"),
        ),
        Chart(
            "position", "error [mm]", tuple(float(i) for i in range(1, len(errors) + 1)), tuple(errors),
            (("allowed", limit_mm), ("", -limit_mm)), False,
        ),
    )  # fmt: skip
