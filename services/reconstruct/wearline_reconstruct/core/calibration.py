"""Calibration: pixels to heights for one head, from flat plates at known heights.

Seen from the camera z = a d / (1 + b d) with d = across - x1 is exact for a laser plane and a
pinhole camera (equation 4-6 of the thesis, counted towards the camera). What is fitted is its
inverse, because the noise is in the pixels: d = g h / (1 - b g h), g = 1/a. x1 and g are smooth
polynomials along each line that change smoothly from line to line, b is one number for the head,
and every shot has an own offset (vibration) with a prior. All parameters are solved together by
Gauss-Newton with robust weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wearline.artifact import Calibration
from wearline.config import Settings
from wearline.errors import CalibrationError
from wearline_reconstruct.core.heights import across_at
from wearline_reconstruct.core.lines import LineSettings
from wearline_reconstruct.core.planes import PlaneLines, plane_lines
from wearline_reconstruct.core.stripes import F64, Image, StripeSettings, strip_image

_BLOCK = 8
_X1_TERMS = 6
_G_TERMS = 4
_DISTANCE_MM = 700.0
"""Where a camera usually stands; its inverse is the prior of b/a."""
_DISTANCE_SPREAD = 0.7
"""Standard deviation of that prior, relative."""


class CalibrationSettings(Settings):
    """What a calibration must fulfil."""

    vibration_px: float = 0.05
    """Expected shift of a whole frame; the shots refine it. [px]"""
    largest_plate_error_mm: float = 0.15
    """A plate further off the others than this is refused. [mm]"""
    doubted_plate_error_mm: float = 0.03
    """One plate of four or more that is further off than this, and clearly more than the others, counts for the shape
    of the lines, not with its height. [mm]"""
    largest_line_rest_mm: float = 0.1
    """A line whose points scatter more than this about flat plates is refused. [mm]"""
    least_shift_px: float = 3.0
    """The lines must move at least this far between the lowest and the highest plate. [px]"""
    margin_share: float = 0.25
    """Valid heights reach this share of the range beyond it, on both sides."""
    margin_mm: float = 0.5
    """And this much more. [mm]"""


@dataclass(frozen=True)
class Shot:
    """One picture of a flat plate."""

    z_mm: float
    pixels: Image
    """uint8 [row, col]"""
    where: str
    """Its name for people."""


@dataclass
class _Solution:
    x1: F64
    """(line, term)"""
    g: F64
    """(line, term)"""
    b: float
    offset: F64
    """(shot,). [px]"""
    residual: F64
    """(shot, line, block), offsets removed. [px]"""
    weight: F64
    covariance: list[F64] = field(default_factory=list)
    """Per line, of its own terms. [px^2]"""
    scale: float = 1.0
    """Residual over what the noise of the frames alone explains."""


def calibrate(
    shots: Sequence[Shot],
    *,
    lines: int,
    is_vertical: bool,
    mm_per_pixel: float | None,
    settings: CalibrationSettings,
    stripes: StripeSettings,
    line_settings: LineSettings,
    seen: Callable[[str], None] | None = None,
) -> Calibration:
    """Calibrate a head.

    Args:
        shots: pictures of plates at two heights or more, several shots per height welcome.
        lines: how many lines the laser projects.
        is_vertical: lines run along the sensor's rows axis.
        mm_per_pixel: lateral scale on z = 0, or None.
        seen: told the name of each picture when it has been read.

    Raises:
        CalibrationError: with the reason and the cure.
    """
    planes = sorted({shot.z_mm for shot in shots})
    if len(planes) < 2:
        raise CalibrationError("needs plates at two heights at least", "calibration", "add another --plane HEIGHT=FILE")
    shape = shots[0].pixels.shape
    pictures: list[PlaneLines] = []
    for shot in shots:
        if shot.pixels.shape != shape:
            raise CalibrationError(
                f"is {shot.pixels.shape[1]} x {shot.pixels.shape[0]} pixels and {shots[0].where} is "
                f"{shape[1]} x {shape[0]}", shot.where, "take all plates with the same camera",
            )  # fmt: skip
        pictures.append(
            plane_lines(strip_image(shot.pixels, is_vertical), lines, shot.where, stripes, line_settings, None)
        )
        if seen is not None:
            seen(shot.where)
    heights = np.array([shot.z_mm for shot in shots])
    _check_shifts(heights, pictures, shots, settings)
    rows, sigma = _blocks(pictures)
    along_size = pictures[0].across_px.shape[1]
    centre = np.asarray(np.arange(rows.shape[2]) * _BLOCK + 0.5 * (_BLOCK - 1), np.float64)
    u = _unit(centre, along_size)
    priors = np.full(len(shots), settings.vibration_px)
    solution = _solve(heights, rows, sigma, u, priors)
    doubted = _doubted(heights, solution, settings)
    if doubted is not None:
        priors[heights == doubted] = _FREE_PX
        solution = _solve(heights, rows, sigma, u, priors)
    _check_fit(heights, planes, solution, shots, settings, doubted)
    return _assemble(
        shots, pictures, heights, rows, solution, along_size, lines, is_vertical, mm_per_pixel, settings, doubted
    )


def _unit(along: F64, size: int) -> F64:
    return np.asarray(2.0 * along / max(size - 1, 1) - 1.0)


def _terms(u: F64, count: int) -> F64:
    """Chebyshev polynomials at u in -1 .. 1: (place, term)."""
    return np.asarray(np.polynomial.chebyshev.chebvander(u, count - 1), np.float64)


def _check_shifts(
    heights: F64, pictures: Sequence[PlaneLines], shots: Sequence[Shot], settings: CalibrationSettings
) -> None:
    """Lines must move one way, and far enough."""
    planes = np.unique(heights)
    stack = np.stack([p.across_px[:, ::_BLOCK] for p in pictures])
    with np.errstate(all="ignore"):
        mean = np.stack([_nanmean(stack[heights == z], 0) for z in planes])
    if not np.isfinite(mean[1:] - mean[:1]).any():
        raise CalibrationError("plates have no line in common", "calibration", "show all lines on every plate")
    shift = np.array([float(np.nanmedian(m - mean[0])) for m in mean])
    steps = np.diff(shift)
    total = shift[-1]
    if abs(total) < settings.least_shift_px:
        raise CalibrationError(
            f"lines move by {abs(total):.1f} px only between {planes[0]:g} and {planes[-1]:g} mm", "calibration",
            "check the heights, or use plates further apart",
        )  # fmt: skip
    turned = np.flatnonzero(steps * total <= 0.0)
    if len(turned):
        k = int(turned[0])
        names = [shots[int(np.flatnonzero(heights == z)[0])].where for z in planes[k : k + 2]]
        raise CalibrationError(
            f"plates at {planes[k]:g} mm ({names[0]}) and {planes[k + 1]:g} mm ({names[1]}) move the lines against"
            " the others", "calibration", "their heights seem to be swapped or wrong",
        )  # fmt: skip
    per_mm = steps / np.diff(planes)
    if len(planes) > 2 and per_mm.max() / per_mm.min() > 1.6:
        k = int(np.argmax(np.abs(np.log(per_mm / np.median(per_mm)))))
        raise CalibrationError(
            f"lines move by {abs(per_mm[k]):.2f} px per mm between {planes[k]:g} and {planes[k + 1]:g} mm but by "
            f"{abs(float(np.median(per_mm))):.2f} elsewhere", "calibration", "one of these heights is wrong",
        )  # fmt: skip


def _nanmean(values: F64, axis: int) -> F64:
    count = np.isfinite(values).sum(axis=axis)
    return np.where(count > 0, np.nansum(values, axis=axis) / np.maximum(count, 1), np.nan)


def _blocks(pictures: Sequence[PlaneLines]) -> tuple[F64, F64]:
    """Means over blocks along the lines, and their sigmas: (shot, line, block)."""
    rows, sigmas = [], []
    for picture in pictures:
        lines, size = picture.across_px.shape
        blocks = -(-size // _BLOCK)
        padded = np.full((2, lines, blocks * _BLOCK), np.nan)
        padded[0, :, :size], padded[1, :, :size] = picture.across_px, picture.sigma_px
        cells = padded.reshape(2, lines, blocks, _BLOCK)
        count = np.isfinite(cells[0]).sum(axis=2)
        # A block that is not full would lie off its own centre on a slanted line.
        mean = np.where(count == _BLOCK, cells[0].mean(axis=2), np.nan)
        spread = np.sqrt(np.nanmean(np.where(np.isfinite(cells[1]), cells[1], 1.0) ** 2, axis=2))
        alike = min(1.0, max(picture.correlation_px / _BLOCK, 1.0 / _BLOCK))
        rows.append(mean)
        sigmas.append(spread * np.sqrt(alike))
    return np.stack(rows), np.stack(sigmas)


_FREE_PX = 1e3
"""Prior of the offset of a shot whose height is not believed. [px]"""


def _solve(heights: F64, rows: F64, sigma: F64, u: F64, prior_px: F64) -> _Solution:
    """Gauss-Newton over all lines at once; unknowns: per line x1 and g terms, then b, then one offset per shot.

    ``prior_px`` is the standard deviation that each shot's offset may have.
    """
    shots, lines, blocks = rows.shape
    terms, shared = _X1_TERMS + _G_TERMS, 1 + shots
    bx = _terms(u, _X1_TERMS)
    bg = _terms(u, _G_TERMS)
    valid = np.isfinite(rows)
    h = heights[:, None]
    slope = _common_slope(heights, rows)
    x1 = np.zeros((lines, _X1_TERMS))
    g = np.zeros((lines, _G_TERMS))
    g[:, 0] = slope
    is_used = np.zeros(lines, bool)
    for line in range(lines):
        use = valid[:, line]
        if use.sum() < 3 * _X1_TERMS or len(np.unique(heights[use.any(axis=1)])) < 2:
            continue
        is_used[line] = True
        value = (rows[:, line] - slope * h)[use]
        x1[line], *_ = np.linalg.lstsq(np.broadcast_to(bx, (shots, blocks, _X1_TERMS))[use], value, rcond=None)
    b_prior = 1.0 / (slope * _DISTANCE_MM)
    b, offset = b_prior, np.zeros(shots)
    base = np.where(valid, 1.0 / np.maximum(sigma, 1e-3) ** 2, 0.0)
    weight, scale, likeness = base.copy(), 30.0, 1.0
    residual = np.zeros_like(rows)
    alike = _likeness(lines, is_used, slope)
    size = lines * terms + shared
    normal = np.eye(size)
    for turn in range(8):
        normal, right = np.zeros((size, size)), np.zeros(size)
        own = lines * terms
        normal[own, own] = 1.0 / (_DISTANCE_SPREAD * b_prior) ** 2
        right[own] = (b_prior - b) * normal[own, own]
        tail = np.arange(own + 1, size)
        normal[tail, tail] = 1.0 / prior_px**2
        right[tail] = -offset / prior_px**2
        values = np.concatenate([x1, g], axis=1)
        for term in range(terms):
            places = np.arange(lines) * terms + term
            normal[np.ix_(places, places)] += alike[term]
            right[places] -= alike[term] @ values[:, term]
        for line in range(lines):
            gl = bg @ g[line]
            denominator = 1.0 - b * gl * h
            res = rows[:, line] - (bx @ x1[line] + gl * h / denominator + offset[:, None])
            residual[:, line] = res
            res = np.where(valid[:, line], res, 0.0)
            w = weight[:, line] / (scale * scale * likeness)
            db = (h * gl) ** 2 / denominator**2
            jac = np.concatenate(
                [np.broadcast_to(bx, (shots, blocks, _X1_TERMS)), (h / denominator**2)[..., None] * bg[None]], axis=2
            )
            mine = slice(line * terms, (line + 1) * terms)
            normal[mine, mine] += np.einsum("sbi,sb,sbj->ij", jac, w, jac, optimize=True) + 1e-9 * np.eye(terms)
            cross = np.empty((terms, shared))
            cross[:, 0] = np.einsum("sbi,sb->i", jac, w * db, optimize=True)
            cross[:, 1:] = np.einsum("sbi,sb->is", jac, w, optimize=True)
            normal[mine, own:] += cross
            normal[own:, mine] += cross.T
            right[mine] += np.einsum("sbi,sb->i", jac, w * res, optimize=True)
            normal[own, own] += float((w * db * db).sum())
            normal[own, own + 1 :] += (w * db).sum(axis=1)
            normal[own + 1 :, own] += (w * db).sum(axis=1)
            normal[tail, tail] += w.sum(axis=1)
            right[own] += float((w * db * res).sum())
            right[own + 1 :] += (w * res).sum(axis=1)
        inverse = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
        step = inverse @ right
        moves = step[:own].reshape(lines, terms)
        x1 += moves[:, :_X1_TERMS]
        g += moves[:, _X1_TERMS:]
        b += float(step[own])
        offset = offset + step[own + 1 :]
        # The first turn starts far away: no robust weights from it.
        if turn > 0:
            with np.errstate(invalid="ignore"):
                ratio = np.abs(residual) * np.sqrt(base)
            scale = max(float(np.nanmedian(ratio)) / 0.6745, 0.3)
            far = np.maximum(np.nan_to_num(ratio), 1e-9) / (3.0 * scale)
            weight = base * np.minimum(1.0, 1.0 / far) ** 2
            likeness = _likeness_along(residual)
    # Of the lines for themselves: what offsets and b leave open is common to all, and counted as such.
    alone = np.asarray(
        np.linalg.pinv(normal[: lines * terms, : lines * terms], rcond=1e-14, hermitian=True), np.float64
    )
    covariance = [alone[k * terms : (k + 1) * terms, k * terms : (k + 1) * terms] for k in range(lines)]
    g[~is_used] = 0.0
    return _Solution(x1, g, b, offset, residual, weight, covariance, scale)


def _likeness_along(residual: F64) -> float:
    """How many neighbouring blocks share one error (streaks of the surface are longer than a block)."""
    run = 8
    cut = residual.shape[2] // run * run
    if cut == 0:
        return 1.0
    cells = residual[:, :, :cut].reshape(*residual.shape[:2], -1, run)
    single = float(np.nanmedian(np.abs(cells)))
    mean = float(np.nanmedian(np.abs(cells.mean(axis=3))))
    return float(np.clip(run * (mean / max(single, 1e-9)) ** 2, 1.0, run))


def _likeness(lines: int, is_used: Any, slope: float) -> list[F64]:
    """Per term a penalty on what departs from a cubic over the lines: one optic makes them all alike.

    The position of each line stays free; its direction, bends and sensitivity depart only as far as
    the plates insist.
    """
    number = np.linspace(-1.0, 1.0, lines)
    smooth = np.polynomial.chebyshev.chebvander(number, min(3, max(int(is_used.sum()) - 2, 0)))
    smooth = np.where(is_used[:, None], smooth, 0.0)
    project = np.diag(is_used.astype(np.float64)) - smooth @ np.linalg.pinv(smooth)
    penalties = []
    for term in range(_X1_TERMS + _G_TERMS):
        if term == 0:
            penalties.append(np.zeros((lines, lines)))
        else:
            allowed = (0.15 if term == 1 else 0.03) if term < _X1_TERMS else 0.001 * abs(slope)
            penalties.append(project / allowed**2)
    return penalties


def _common_slope(heights: F64, rows: F64) -> float:
    """px per mm over all lines."""
    low, high = heights == heights.min(), heights == heights.max()
    shift = _nanmean(rows[high], 0) - _nanmean(rows[low], 0)
    return float(np.nanmedian(shift)) / float(heights.max() - heights.min())


def _check_fit(
    heights: F64, planes: Sequence[float], solution: _Solution, shots: Sequence[Shot], settings: CalibrationSettings,
    doubted: float | None,
) -> None:  # fmt: skip
    """A plate that does not fit the others has a wrong height, or is no plate."""
    a = 1.0 / float(np.median(solution.g[:, 0]))
    for k, shot in enumerate(shots):
        spread = float(np.nanmedian(np.abs(solution.residual[k]))) * abs(a) / 0.6745
        if spread > settings.largest_plate_error_mm:
            raise CalibrationError(
                f"is off a flat plate at {shot.z_mm:g} mm by {spread:.2f} mm here and there", shot.where,
                "check that the plate is flat, lies flat, and its height is right",
            )  # fmt: skip
    per_line = _line_rests(solution, a)
    if float(np.nanmax(per_line)) > settings.largest_line_rest_mm:
        line = int(np.nanargmax(per_line))
        raise CalibrationError(
            f"line {line} scatters by {per_line[line]:.2f} mm about flat plates", "calibration",
            "check focus and exposure, and that nothing reflects the laser",
        )  # fmt: skip
    if len(planes) < 3:
        return
    found = _left_out(heights, solution, settings.vibration_px, heights != doubted)
    worst = max(found, key=lambda one: abs(one.error_mm))
    if doubted is None:
        # Where it is one plate, its neighbours look wrong as well; of three, the middle one says how much.
        worst = min(found, key=lambda one: one.rest if len(found) > 3 else one.sigma_mm)
    if abs(worst.error_mm) > settings.largest_plate_error_mm:
        name = shots[int(np.flatnonzero(heights == worst.z_mm)[0])].where
        raise CalibrationError(
            f"the plate at {worst.z_mm:g} mm lies {worst.error_mm:+.2f} mm off the others", name,
            "check the height that was entered for it",
        )  # fmt: skip


@dataclass(frozen=True)
class _LeftOut:
    """One plane beside what the others say of it."""

    z_mm: float
    error_mm: float
    """Where it lies off their prediction, towards the camera. [mm]"""
    sigma_mm: float
    """Standard uncertainty of that by vibration. [mm]"""
    rest: float
    """How far the others are off their own fit: mean square in units of vibration."""


def _left_out(heights: F64, solution: _Solution, vibration_px: float, believed: Any) -> list[_LeftOut]:
    """Each plane left out in turn of a fit through the mean places of all lines.

    The mean place moves by x0 + g h + b g^2 h^2 (equation 4-6 expanded; the next term is far below a
    micrometre's worth); the last coefficient has its prior from where cameras stand.
    """
    slope = float(np.median(solution.g[np.any(solution.g != 0.0, axis=1), 0]))
    bend = slope / _DISTANCE_MM
    place = heights * slope / (1.0 - solution.b * slope * heights) + solution.offset
    place = place + np.nanmedian(solution.residual, axis=(1, 2))
    basis = np.stack([np.ones_like(heights), heights, heights**2], axis=1)
    prior = np.diag([0.0, 0.0, (vibration_px / (_DISTANCE_SPREAD * bend)) ** 2])
    found = []
    for z in np.unique(heights):
        mine = heights == z
        used = ~mine & believed
        if len(np.unique(heights[used])) < 2:
            continue
        normal = basis[used].T @ basis[used] + prior
        inverse = np.linalg.inv(normal)
        fit = inverse @ (basis[used].T @ place[used] + prior @ np.array([0.0, 0.0, bend]))
        error = float(np.mean(place[mine] - basis[mine] @ fit)) / slope
        leverage = float(basis[mine][0] @ inverse @ basis[mine][0])
        sigma = vibration_px * float(np.sqrt(1.0 / mine.sum() + leverage)) / abs(slope)
        rest = float(np.mean((place[used] - basis[used] @ fit) ** 2)) / vibration_px**2
        found.append(_LeftOut(float(z), error, sigma, rest))
    return found


def _doubted(heights: F64, solution: _Solution, settings: CalibrationSettings) -> float | None:
    """Height of the one plane that contradicts all others, which agree; None = there is none."""
    if len(np.unique(heights)) < 4:
        return None
    every = np.ones(len(heights), bool)
    best = min(_left_out(heights, solution, settings.vibration_px, every), key=lambda one: one.rest)
    is_off = abs(best.error_mm) > max(settings.doubted_plate_error_mm, 4.0 * best.sigma_mm)
    return best.z_mm if is_off and best.rest < 4.0 else None


def _assemble(
    shots: Sequence[Shot], pictures: Sequence[PlaneLines], heights: F64, rows: F64, solution: _Solution,
    along_size: int, lines: int, is_vertical: bool, mm_per_pixel: float | None, settings: CalibrationSettings,
    doubted: float | None,
) -> Calibration:  # fmt: skip
    along = np.arange(along_size, dtype=np.float64)
    u = _unit(along, along_size)
    bx = _terms(u, _X1_TERMS)
    bg = _terms(u, _G_TERMS)
    x1 = solution.x1 @ bx.T
    g = solution.g @ bg.T
    x1 = x1 + _unmodelled(solution, along_size)
    seen = np.stack([np.isfinite(p.across_px) for p in pictures])
    planes = np.unique(heights)
    shown = np.stack([seen[heights == z].any(axis=0) for z in planes]).sum(axis=0) >= 2
    known = _covered(shown)
    with np.errstate(divide="ignore"):
        a = np.where(known & (np.abs(g) > 1e-6), 1.0 / g, np.nan)
    x1 = np.where(known, x1, np.nan)
    span = float(planes[-1] - planes[0])
    margin = settings.margin_share * span + settings.margin_mm
    z_range = np.array([planes[0] - margin, planes[-1] + margin])
    believed = heights != doubted
    vibration = _vibration(solution.offset[believed], heights[believed], settings.vibration_px)
    common, own = _uncertainty(solution, heights[believed], z_range, bx, bg, a, vibration)
    scale_mm = float(mm_per_pixel) if mm_per_pixel else float("nan")
    widths = [p.scale.width_px for p in pictures]
    a_usual = float(np.nanmedian(a))
    noise = _noise(shots, pictures, is_vertical)
    texture, streak = _texture(solution, pictures)
    residual = [
        {
            "where": shot.where,
            "z_mm": shot.z_mm,
            "offset_mm": round(float(solution.offset[k]) * a_usual, 5),
            "rms_mm": round(float(np.nanmedian(np.abs(solution.residual[k]))) / 0.6745 * abs(a_usual), 5),
            "lines": int((seen[k].sum(axis=1) > 0.25 * along_size).sum()),
        }
        for k, shot in enumerate(shots)
    ]
    meta: dict[str, Any] = {
        "planes_mm": [float(z) for z in planes],
        "shots": residual,
        "planes": [
            {
                "z_mm": one.z_mm,
                "left_out_mm": round(one.error_mm, 5),
                "sigma_mm": round(one.sigma_mm, 5),
                "is_believed": one.z_mm != doubted,
            }
            for one in _left_out(heights, solution, settings.vibration_px, believed)
        ],
        "lines": [
            {
                "line": k,
                "rest_mm": None if not np.isfinite(rest) else round(float(rest), 5),
                "covered": round(float(known[k].mean()), 4),
            }
            for k, rest in enumerate(_line_rests(solution, a_usual))
        ],
        "vibration_px": round(vibration, 5),
        "z_sigma_common_mm": round(common, 6),
        "pitch_px": round(float(np.median([p.scale.pitch_px for p in pictures])), 3),
        "signal_dn": round(float(np.median([p.signal_dn for p in pictures])), 2),
        "noise_dn": round(float(np.median([p.noise_dn for p in pictures])), 3),
        "texture_px": round(texture, 4),
        "streak_px": round(streak, 1),
        "mm_per_line_px": round(a_usual, 6),
    }
    draft = Calibration(
        a_mm_per_px=a, across0_px=x1, b_per_px=float(solution.b), z_sigma_mm=np.sqrt(common**2 + own**2),
        z_range_mm=z_range, image_shape=np.array(shots[0].pixels.shape, np.int64), is_vertical=is_vertical,
        spot_px=np.full(2, np.nan), stripe_width_px=float(np.median(widths)), noise=noise, mm_per_pixel=scale_mm,
        meta=meta,
    )  # fmt: skip
    return _with_spot(draft, pictures, heights)


def _line_rests(solution: _Solution, a_usual: float) -> F64:
    """Robust spread of each line's points about flat plates; NaN = not seen. [mm]"""
    rest = np.full(solution.residual.shape[1], np.nan)
    for line, mine in enumerate(np.moveaxis(solution.residual, 1, 0)):
        if np.isfinite(mine).any():
            rest[line] = 1.4826 * float(np.nanmedian(np.abs(mine))) * abs(a_usual)
    return rest


def _unmodelled(solution: _Solution, along_size: int) -> F64:
    """What all plates show alike beside the polynomials: a line that is not smooth at its source."""
    stack = solution.residual
    lines, blocks = stack.shape[1:]
    correction = np.zeros((lines, along_size))
    count = np.isfinite(stack).sum(axis=0)
    if stack.shape[0] < 3:
        return correction
    mean = _nanmean(stack, 0)
    scatter = np.sqrt(_nanmean((stack - mean) ** 2, 0) / np.maximum(count - 1, 1))
    taps = np.exp(-0.5 * (np.arange(-6, 7) / 2.5) ** 2)
    filled = np.where(np.isfinite(mean), mean, 0.0)
    have = np.isfinite(mean).astype(np.float64)
    smooth = np.stack([np.convolve(f, taps, "same") / np.maximum(np.convolve(w, taps, "same"), 1e-6)
                       for f, w in zip(filled, have, strict=True)])  # fmt: skip
    expected = float(np.nanmedian(scatter)) * float(np.sqrt((taps**2).sum()) / taps.sum()) * 2.0
    if float(np.sqrt(np.nanmean(smooth**2))) < 2.0 * expected + 0.01:
        return correction
    centre = np.arange(blocks) * _BLOCK + 0.5 * (_BLOCK - 1)
    for line in range(lines):
        correction[line] = np.interp(np.arange(along_size), centre, smooth[line])
    return correction


def _covered(shown: Any) -> Any:
    """Where the plates showed each line, short gaps filled: (line, along) bool."""
    along = np.arange(shown.shape[1])
    result = np.zeros_like(shown)
    for line, row in enumerate(shown):
        places = np.flatnonzero(row)
        if len(places) < 0.1 * len(row):
            continue
        nearest = places[np.clip(np.searchsorted(places, along), 0, len(places) - 1)]
        before = places[np.clip(np.searchsorted(places, along, side="right") - 1, 0, len(places) - 1)]
        inside = (along >= places[0] - 12) & (along <= places[-1] + 12)
        result[line] = inside & (np.minimum(np.abs(nearest - along), np.abs(along - before)) < 64)
    return result


def _vibration(offset: F64, heights: F64, prior_px: float) -> float:
    """Standard deviation of the shift of a whole frame: what the shots show, weighed with what is usual."""
    freedom = max(len(heights) - min(len(np.unique(heights)), 3), 0)
    # The offsets are shrunk by their own prior and by what the heights absorb; the count of freedoms allows for that.
    total = float((offset**2).sum())
    return float(np.sqrt((3.0 * prior_px**2 + total) / (3.0 + freedom)))


def _uncertainty(
    solution: _Solution, heights: F64, z_range: F64, bx: F64, bg: F64, a: F64, vibration_px: float
) -> tuple[float, F64]:
    """Standard uncertainty common to all heights, and (line, along) each one's own. [mm]"""
    a_usual = abs(float(np.nanmedian(a)))
    mean = float(heights.mean())
    spread = float(((heights - mean) ** 2).sum())
    z = np.linspace(z_range[0], z_range[1], 9)
    shift = vibration_px * np.sqrt(1.0 / len(heights) + (z - mean) ** 2 / spread)
    common = a_usual * float(np.sqrt(np.mean(shift**2)))
    own = np.zeros_like(a)
    middle = 0.5 * (z_range[0] + z_range[1])
    reach = float(np.sqrt(np.mean((z - middle) ** 2)))
    for line, covariance in enumerate(solution.covariance):
        total = np.zeros(len(bx))
        for height in (middle - reach, middle + reach):
            jac = np.concatenate([bx, height * bg], axis=1)
            total += 0.5 * np.einsum("ai,ij,aj->a", jac, covariance, jac, optimize=True)
        own[line] = np.sqrt(np.maximum(total, 0.0)) * np.abs(a[line])
    return common, own


_USUAL_STREAK_PX = 60.0
"""Length of streaks of rolled sheet, where the plates do not show any. [px]"""


def _texture(solution: _Solution, pictures: Sequence[PlaneLines]) -> tuple[float, float]:
    """What stays in a point's position after the fast noise, streaks of the surface, and how long they are. [px]"""
    short, long = 4, 16
    own = float(np.median([np.nanmedian(p.sigma_px) ** 2 * p.correlation_px for p in pictures]))

    def variance(blocks: int) -> float:
        slow = solution.residual[:, :, : solution.residual.shape[2] // blocks * blocks]
        mean = slow.reshape(*slow.shape[:2], -1, blocks).mean(axis=3)
        if not np.isfinite(mean).any():
            return 0.0
        return max((float(np.nanmedian(np.abs(mean))) / 0.6745) ** 2 - own / (blocks * _BLOCK), 0.0)

    near, far = variance(short), variance(long)
    if near < 0.1 * own / (short * _BLOCK):
        return float(np.sqrt(near)), _USUAL_STREAK_PX
    # Means over W of what is alike over S have the share S / (S + W) of its variance.
    ratio = min(far / near, 0.8)
    streak = (long * ratio - short) * _BLOCK / (1.0 - ratio)
    # The smoother's reach is not long against a streak, so that less than all of it counts.
    return float(np.sqrt(near)), float(np.clip(0.75 * streak, 0.4 * _USUAL_STREAK_PX, 2.0 * _USUAL_STREAK_PX))


def _noise(shots: Sequence[Shot], pictures: Sequence[PlaneLines], is_vertical: bool) -> F64:
    """Read noise [DN], gain [DN per electron], speckle contrast, speckle correlation length [px]; NaN = not known."""
    strip = strip_image(shots[0].pixels, is_vertical)
    picture = pictures[0]
    line, along = np.nonzero(np.isfinite(picture.across_px))
    centre = np.rint(picture.across_px[line, along]).astype(np.int64)
    top = np.full(picture.across_px.shape, np.nan)
    top[line, along] = strip[along, np.clip(centre, 0, strip.shape[1] - 1)]
    top[top >= 254.0] = np.nan
    away = 0.5 * picture.scale.pitch_px if np.isfinite(picture.scale.pitch_px) else 8.0 * picture.scale.width_px
    dark_at = np.clip(np.rint(picture.across_px[line, along] + away), 0, strip.shape[1] - 1).astype(np.int64)
    dark = np.full(top.shape, np.nan)
    dark[line, along] = strip[along, dark_at]
    read = float(np.sqrt(max(np.nanmean((dark[:, 1:] - dark[:, :-1]) ** 2) / 2.0, 1.0 / 12.0)))
    height = top - np.nanmedian(dark)
    usual = float(np.nanmean(height))

    def half_difference(lag: int) -> float:
        return float(np.nanmean((height[:, lag:] - height[:, :-lag]) ** 2) / 2.0)

    far = half_difference(12)
    contrast = float(np.sqrt(max(far - read**2, 0.0))) / max(usual, 1.0)
    lags = np.arange(1, 9)
    alike = np.array([1.0 - (half_difference(int(k)) - read**2) / max(far - read**2, 1e-9) for k in lags])
    below = np.flatnonzero(alike < np.exp(-1.0))
    if not len(below):
        length = 8.0
    elif below[0] == 0:
        length = float((1.0 - np.exp(-1.0)) / max(1.0 - alike[0], 1e-6))
    else:
        k = int(below[0])
        length = float(lags[k - 1] + (alike[k - 1] - np.exp(-1.0)) / max(alike[k - 1] - alike[k], 1e-6))
    return np.array([read, np.nan, contrast, length])


def _with_spot(draft: Calibration, pictures: Sequence[PlaneLines], heights: F64) -> Calibration:
    """Add where the spot lies at z = 0: on the middle line, at the place along it that the plates extrapolate to."""
    found = [(z, p.spot) for z, p in zip(heights, pictures, strict=True) if p.spot is not None]
    if not found:
        return draft
    z = np.array([height for height, _ in found])
    along = np.array([spot.along_px for _, spot in found])
    fit = np.polyfit(z, along, 1) if len(np.unique(z)) > 1 else np.array([0.0, float(along.mean())])
    at = float(fit[1])
    place = int(np.clip(round(at), 0, draft.across0_px.shape[1] - 1))
    across = float(across_at(draft, 0.0)[draft.lines // 2, place])
    spot = np.array([at, across]) if draft.is_vertical else np.array([across, at])
    excess = float(np.median([s.excess for _, s in found]))
    drift = round(float(fit[0]), 5)
    return replace(
        draft, spot_px=spot, meta={**draft.meta, "spot_along_px_per_mm": drift, "spot_excess": round(excess, 3)}
    )
