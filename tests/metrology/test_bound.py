"""Stripe centres against the Cramér-Rao bound of a single column: how much an ideal estimator could still gain."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from wearline_reconstruct.core.stripes import F64, Scale, StripeSettings, stripe_peaks

COLUMNS, ACROSS = 6000, 160
READ_DN, GAIN_DN = 1.0, 0.024


def bound_px(width: float, peak: float, contrast: float, length: float, ambient: float) -> float:
    """Standard deviation of generalised least squares with known width, noise and speckle correlation.

    Centre, height and background are unknown; covariance C^2 S R S (speckle) + read and shot noise.
    """
    x = np.arange(-40.0, 41.0)
    profile = peak * np.exp(-0.5 * (x / width) ** 2)
    alike = np.exp(-(((x[:, None] - x) / length) ** 2))
    covariance = contrast**2 * profile[:, None] * alike * profile
    covariance += np.diag(READ_DN**2 + GAIN_DN * (profile + ambient) + 1.0 / 12.0)
    slopes = np.column_stack([profile * x / width**2, profile / peak, np.ones_like(x)])
    return float(np.sqrt(np.linalg.inv(slopes.T @ np.linalg.solve(covariance, slopes))[0, 0]))


def stripe(
    width: float, peak: float, contrast: float, length: float, ambient: float, seed: int
) -> tuple[NDArray[np.uint8], F64]:
    """One isolated stripe as a strip image [along, across], and its true centre in each column."""
    rng = np.random.default_rng(seed)
    true = 80.0 + 0.3 * np.sin(np.arange(COLUMNS) / 97.0)
    field = cv2.GaussianBlur(rng.standard_normal((COLUMNS, ACROSS)), (0, 0), 0.5 * length)
    field = (field - field.mean()) / field.std()
    # Wilson and Hilferty: the cube of a normal field has nearly gamma statistics.
    speckle = np.maximum(1.0 - contrast**2 / 9.0 + contrast / 3.0 * field, 0.0) ** 3
    light = peak * np.exp(-0.5 * ((np.arange(ACROSS) - true[:, None]) / width) ** 2) * speckle + ambient
    light += rng.standard_normal(light.shape) * np.sqrt(GAIN_DN * light + READ_DN**2)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8), true


@pytest.mark.parametrize(
    ("width", "contrast", "length", "ambient", "limit"),
    [
        (2.0, 0.35, 1.5, 12.0, 1.15),
        (2.0, 0.3, 1.0, 5.0, 1.15),
        (1.5, 0.35, 1.5, 12.0, 1.2),
        (2.0, 0.35, 1.5, 60.0, 1.2),
    ],
    ids=["dark", "fine speckle", "narrow", "bright"],
)
def test_a_single_column_comes_near_the_bound(
    width: float, contrast: float, length: float, ambient: float, limit: float
) -> None:
    strip, true = stripe(width, 110.0, contrast, length, ambient, 3)
    peaks = stripe_peaks(strip, Scale(width, float("inf")), StripeSettings(average_px=1))
    error = peaks.across_px - true[peaks.along]
    # What noise alone lifts over the threshold of a single column, somewhere else.
    assert float(np.mean(np.abs(error) > 3.0)) < 0.002
    error = error[np.abs(error) < 3.0]
    assert len(error) > 0.995 * COLUMNS
    ratio = float(np.std(error)) / bound_px(width, 110.0, contrast, length, ambient)
    assert abs(float(np.mean(error))) < 0.01
    # Less than 1 would mean that the bound, or the noise that was drawn, is wrong.
    assert 0.95 < ratio < limit
