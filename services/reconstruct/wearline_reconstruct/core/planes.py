"""Line numbers in a picture of a flat plate: the comb is regular there, and the spot anchors it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wearline.errors import CalibrationError
from wearline_reconstruct.core.lines import Fragments, LineSettings, fragments
from wearline_reconstruct.core.spot import Spot, find_spots
from wearline_reconstruct.core.stripes import F64, I64, Image, Scale, StripeSettings, estimate_scale, stripe_peaks


@dataclass(frozen=True)
class PlaneLines:
    """The numbered lines of one picture of a plate."""

    across_px: F64
    """(line, along), NaN = not seen. [px]"""
    sigma_px: F64
    """(line, along). [px]"""
    correlation_px: float
    spot: Spot | None
    scale: Scale
    noise_dn: float
    signal_dn: float
    saturated: float
    """Share of saturated peaks."""


def plane_lines(
    strip: Image, lines: int, where: str, stripes: StripeSettings, line_settings: LineSettings, scale: Scale | None
) -> PlaneLines:
    """Number the lines on a flat plate.

    Raises:
        CalibrationError: no stripes, no spot, more lines than there are, too few of them.
    """
    scale = scale or estimate_scale(strip)
    if not np.isfinite(scale.pitch_px):
        raise CalibrationError("shows no regular pattern of lines", where, "check focus, exposure and --orientation")
    peaks = stripe_peaks(strip, scale, stripes)
    found = fragments(peaks, scale, stripes.average_px, line_settings)
    along_size = strip.shape[0]
    if not found.count or len(found.peaks) < 0.2 * along_size:
        raise CalibrationError("shows no laser lines", where, "check laser, exposure and --orientation")
    # The usual size refines the scale of this head.
    scale = Scale(float(np.median(found.peaks.width_px)) if scale is None else scale.width_px, scale.pitch_px)
    number = _comb_numbers(found, scale, along_size)
    spot, origin = _anchor(strip, found, number, scale, lines, where)
    number = np.where(number == _NONE, _NONE, number - origin)
    of_point = number[found.label]
    seen = np.unique(number[(number != _NONE) & (np.bincount(found.label) > 0.25 * along_size)])
    if len(seen) and (seen.min() < 0 or seen.max() >= lines):
        raise CalibrationError(
            f"shows {int(((seen < 0) | (seen >= lines)).sum())} lines beyond the {lines} lines"
            " when counted from the spot", where, "check --lines and that nothing else reflects the laser",
        )  # fmt: skip
    if len(seen) < max(3, int(0.6 * lines)):
        raise CalibrationError(
            f"shows only {len(seen)} of {lines} lines",
            where,
            "the plate must fill the picture; check exposure and --lines",
        )
    across = np.full((lines, along_size), np.nan)
    sigma = np.full((lines, along_size), np.nan)
    good = (of_point >= 0) & (of_point < lines)
    across[of_point[good], found.peaks.along[good]] = found.peaks.across_px[good]
    sigma[of_point[good], found.peaks.along[good]] = found.sigma_px[good]
    return PlaneLines(
        across, sigma, found.correlation_px, spot, scale, peaks.noise_dn, float(np.median(found.peaks.signal_dn)),
        float(np.mean(found.peaks.is_saturated)),
    )  # fmt: skip


_NONE = -(10**6)


def _comb_numbers(found: Fragments, scale: Scale, along_size: int) -> I64:
    """A number for each fragment, counted from any one of them; `_NONE` where nothing joins it."""
    peaks, label = found.peaks, found.label
    order = np.lexsort((peaks.across_px, peaks.along))
    along, across, owner = peaks.along[order], peaks.across_px[order].astype(np.float64), label[order]
    same = along[1:] == along[:-1]
    upper, lower = owner[:-1][same], owner[1:][same]
    gap, middle = (across[1:] - across[:-1])[same], 0.5 * (across[1:] + across[:-1])[same]
    # The pitch drifts over the picture by perspective: a straight line through the single gaps.
    single = np.abs(gap / scale.pitch_px - 1.0) < 0.35
    if single.sum() < 20:
        return np.where(np.arange(found.count) == int(np.argmax(np.bincount(label))), 0, _NONE)
    trend = np.polyfit(middle[single], gap[single], 1)
    steps = gap / np.polyval(trend, middle)
    pair, inverse = np.unique(upper * found.count + lower, return_inverse=True)
    weight = np.bincount(inverse)
    mean = np.bincount(inverse, weights=steps) / weight
    whole = np.rint(mean)
    sure = (np.abs(mean - whole) < 0.3) & (whole >= 1)
    number = np.full(found.count, _NONE, np.int64)
    number[int(np.argmax(np.bincount(label)))] = 0
    # Best-joined first: a spanning tree of the longest common stretches.
    edges = sorted(
        ((int(w), int(p // found.count), int(p % found.count), int(n))
         for w, p, n, ok in zip(weight, pair, whole, sure, strict=True) if ok and w >= 5), reverse=True,
    )  # fmt: skip
    grew = True
    while grew:
        grew = False
        for _, above, below, apart in edges:
            if number[above] != _NONE and number[below] == _NONE:
                number[below] = number[above] + apart
            elif number[below] != _NONE and number[above] == _NONE:
                number[above] = number[below] - apart
            else:
                continue
            grew = True
            break
    size = np.bincount(label)
    taken: dict[int, list[int]] = {}
    for fragment in np.argsort(-size):
        if number[fragment] == _NONE:
            continue
        mine = peaks.along[label == fragment]
        others = taken.setdefault(int(number[fragment]), [])
        if any(len(np.intersect1d(mine, peaks.along[label == other])) > 2 for other in others):
            number[fragment] = _NONE
        else:
            others.append(int(fragment))
    return number


def _anchor(
    strip: Image, found: Fragments, number: I64, scale: Scale, lines: int, where: str
) -> tuple[Spot | None, int]:
    """The spot and the number (as counted) of the line that is line 0."""
    long = np.bincount(found.label) > 0.4 * strip.shape[0]
    seen = np.unique(number[(number != _NONE) & long])
    if lines % 2 == 0:
        if len(seen) != lines or seen[-1] - seen[0] != lines - 1:
            raise CalibrationError(
                f"shows {len(seen)} of {lines} lines, and an even number has no middle line to count from", where,
                "show all lines on the plate",
            )  # fmt: skip
        return None, int(seen[0])
    for spot in find_spots(strip, scale):
        best = _line_at(found, number, spot, 5.0 * scale.pitch_px)
        if best is None or best[1] > 0.35 * scale.pitch_px:
            continue
        origin = best[0] - lines // 2
        if len(seen) and (seen[0] - origin < 0 or seen[-1] - origin >= lines):
            continue
        return spot, origin
    raise CalibrationError(
        "shows no centre spot that fits the lines", where,
        "the spot of the middle line must be on the plate and not be covered; check --lines and --orientation",
    )  # fmt: skip


def _line_at(found: Fragments, number: I64, spot: Spot, reach_px: float) -> tuple[int, float] | None:
    """Number of the line that passes nearest to the spot, by straight lines fitted about it, and its distance [px]."""
    near = np.flatnonzero((np.abs(found.peaks.along - spot.along_px) < reach_px) & (number[found.label] != _NONE))
    named = number[found.label[near]]
    distances = {}
    for name in np.unique(named):
        mine = near[named == name]
        along = found.peaks.along[mine] - spot.along_px
        if len(mine) < 10 or np.ptp(along) < 0.5 * reach_px:
            continue
        fit = np.polyfit(along, found.peaks.across_px[mine].astype(np.float64), 1)
        distances[int(name)] = abs(float(fit[1]) - spot.across_px)
    if not distances:
        return None
    best = min(distances, key=lambda name: distances[name])
    return best, distances[best]
