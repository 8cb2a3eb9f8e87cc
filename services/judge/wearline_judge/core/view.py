"""Decimated maps for the eye."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wearline_judge.core.comparison import Comparison, block_position
from wearline_judge.core.golden import Golden
from wearline_judge.core.line_grid import F64

NAMES = ("standard", "measured", "difference", "error")


def _between_lines(values: F64, across: F64, positions: F64) -> F64:
    """Linear interpolation between neighbouring lines; (line, block) at (position,) -> (position, block).

    NaN beyond the outermost lines and wherever one of the two neighbours has no value.
    """
    lines, blocks = values.shape
    # A line that is missing at a place must not swallow the order of the others.
    order = np.where(np.isfinite(across), across, np.inf)
    upper = (positions[:, None, None] >= order[None]).sum(axis=1)
    below = np.clip(upper - 1, 0, lines - 1)
    above = np.clip(upper, 0, lines - 1)
    column = np.broadcast_to(np.arange(blocks), below.shape)
    a0, a1 = across[below, column], across[above, column]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (positions[:, None] - a0) / (a1 - a0)
        mixed = values[below, column] * (1.0 - share) + values[above, column] * share
    return np.where((upper > 0) & (upper < lines), mixed, np.nan)


def make_view(golden: Golden, comparison: Comparison, longest: int = 160) -> tuple[NDArray[np.float32], float]:
    """Maps (map, row, col) in the order of `NAMES` [mm] over the template's ROI, and the step between elements [px]."""
    _, _, width, height = golden.roi
    step = max(1, -(-max(width, height) // longest))
    standard = golden.map_mm[::step, ::step].astype(np.float64)
    rows = golden.roi[1] + np.arange(standard.shape[0], dtype=np.float64) * step
    cols = golden.roi[0] + np.arange(standard.shape[1], dtype=np.float64) * step
    x, y = block_position(golden)
    across, along = (x, y) if golden.is_vertical else (y, x)
    at_across, at_along = (cols, rows) if golden.is_vertical else (rows, cols)
    error = np.where(
        comparison.label > 0, comparison.deviation_mm, np.where(np.isnan(comparison.deviation_mm), np.nan, 0.0)
    )
    # Nearest cell along the line: cells are no longer than a step.
    has = np.isfinite(along)
    count = has.sum(axis=0)
    centre = np.where(count > 0, np.where(has, along, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
    known = np.flatnonzero(np.isfinite(centre))
    if not known.size:
        return np.full((4, *standard.shape), np.nan, np.float32), float(step)
    nearest = known[np.argmin(np.abs(centre[known][:, None] - at_along[None, :]), axis=0)]
    is_far = np.abs(centre[nearest] - at_along) > 2.0 * step + 8.0
    maps = []
    for values in (comparison.deviation_mm, error):
        found = _between_lines(values[:, nearest], across[:, nearest], at_across)
        found[:, is_far] = np.nan
        maps.append(found.T if golden.is_vertical else found)
    difference, shown = (np.where(np.isfinite(standard), m, np.nan) for m in maps)
    return np.stack([standard, standard + difference, difference, shown]).astype(np.float32), float(step)
