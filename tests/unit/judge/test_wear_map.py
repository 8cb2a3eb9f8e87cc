"""Running sums over parts give what all parts at once would."""

from __future__ import annotations

import numpy as np

from wearline.messages import Region
from wearline_judge.core.comparison import Comparison, Doubt, TemplateCells
from wearline_judge.core.registration import Motion
from wearline_judge.core.wear_map import empty_map, restored, updated

LINES, BLOCKS = 6, 10
X, Y = np.meshgrid(np.arange(BLOCKS) * 16.0 + 108.0, np.arange(LINES) * 20.0 + 60.0)
ONES = np.ones((LINES, BLOCKS))
CELLS = TemplateCells(
    wanted=np.ones((LINES, BLOCKS * 8), bool), expected=8 * ONES, x_px=X, y_px=Y, z_mm=0 * ONES, slope_x=0 * ONES,
    slope_y=0 * ONES, offset_mm=0 * ONES, noise_mm2=0 * ONES, natural_mm2=0 * ONES, area_px=160 * ONES,
    middle_px=(0.0, 0.0), middle_z_mm=0.0,
)  # fmt: skip
ROI = (100, 50, 160, 120)


def part(deviation: np.ndarray, label: np.ndarray) -> Comparison:
    doubt = Doubt(0.01 * ONES, 0 * ONES, 0 * ONES, 120.0)
    regions: tuple[Region, ...] = ()
    return Comparison(
        deviation, 0.01 * ONES, doubt, CELLS.area_px, label, CELLS.expected, CELLS.expected, regions, Motion()
    )


def test_slope_and_error_share_are_those_of_all_parts() -> None:
    rng = np.random.default_rng(1)
    growth = np.where(X > 180.0, 5e-6, 0.0)
    wear = empty_map(ROI, 40)
    strokes = 1_000_000 + np.cumsum(rng.integers(1, 50, 80))
    kept: list[np.ndarray] = []
    errors = np.zeros(wear.count.shape)
    for stroke in strokes:
        deviation = growth * (stroke - strokes[0]) + rng.normal(0.0, 0.002, X.shape)
        label = np.where(deviation > 0.008, 1, 0).astype(np.int32)
        deviation[rng.random(X.shape) < 0.02] = np.nan
        wear = updated(wear, int(stroke), part(deviation, label), CELLS)
        squares = np.full(wear.count.shape, np.nan)
        for row in range(3):
            for col in range(4):
                own = (row == (Y - 50) // 40) & (col == (X - 100) // 40) & np.isfinite(deviation)
                if own.any():
                    squares[row, col] = deviation[own].mean()
                    errors[row, col] += (label[own] > 0).any()
        kept.append(squares)
    slope, sigma = wear.slope()
    assert slope.shape == (3, 4)
    for row in range(3):
        for col in range(4):
            y = np.array([k[row, col] for k in kept])
            seen = np.isfinite(y)
            design = np.column_stack([np.ones(seen.sum()), strokes[seen] - strokes[0]])
            fitted, rest, *_ = np.linalg.lstsq(design, y[seen], rcond=None)
            own = np.sqrt(rest[0] / (seen.sum() - 2) * np.linalg.inv(design.T @ design)[1, 1])
            np.testing.assert_allclose(slope[row, col], 1e3 * fitted[1], rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(sigma[row, col], 1e3 * own, rtol=1e-4)
    np.testing.assert_array_equal(wear.errors, errors)
    assert (wear.error_share[:, -1] > 0.3).all() and (wear.error_share[:, 0] < 0.05).all()
    significance = wear.significance()
    assert (significance[:, -1] > 10.0).all() and (np.abs(significance[:, 0]) < 4.0).all()


def test_what_was_never_seen_stays_unknown_and_sums_survive_storage() -> None:
    wear = empty_map((0, 0, 400, 300), 50)
    for stroke in (1, 2, 5):
        wear = updated(wear, stroke, part(0.01 * stroke * ONES, np.zeros(X.shape, np.int32)), CELLS)
    slope, _ = wear.slope()
    assert np.isnan(slope[0, 0]) and np.isnan(wear.error_share[0, 0])
    assert np.nanmin(slope) > 9.9 and np.nanmax(slope) < 10.1, "10 mm per 1000 strokes"
    again = restored(wear.square_px, wear.origin_px, wear.arrays())
    for name, values in wear.arrays().items():
        np.testing.assert_array_equal(values, again.arrays()[name])
