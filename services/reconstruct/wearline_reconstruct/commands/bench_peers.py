"""What a user would pick instead of our extraction: written from the papers, run with one setting each."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.scene import Truth
from wearline_reconstruct.config import ReconstructSettings
from wearline_reconstruct.core.lines import fragments
from wearline_reconstruct.core.stripes import Scale, strip_image, stripe_peaks
from wearline_reconstruct.core.thesis import ThesisSettings, thesis_fragments, thesis_peaks

U8 = NDArray[np.uint8]
Points = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Row and column of each point. [px]"""
_NEAR_PX = 3.0


@dataclass(frozen=True)
class PeerResult:
    """One extraction against the truth."""

    name: str
    ms: float
    """Shortest of three runs."""
    recall: float
    rms_px: float
    junk: int
    """Points without a line within 3 px, and second points of one place."""


def compare_peers(pixels: U8, truth: Truth, scale: Scale) -> list[PeerResult]:
    """Ours, the thesis' and what else is installed, on one frame with horizontal lines."""
    settings = ReconstructSettings()
    strip = strip_image(pixels, False)

    def ours() -> Points:
        found = fragments(
            stripe_peaks(strip_image(pixels, False), scale, settings.stripes), scale, settings.stripes.average_px,
            settings.lines,
        )  # fmt: skip
        return found.peaks.across_px.astype(np.float64), found.peaks.along.astype(np.float64)

    def thesis() -> Points:
        chosen = ThesisSettings()
        found = thesis_fragments(thesis_peaks(strip, scale, settings.stripes, chosen), scale, chosen)
        return found.peaks.across_px.astype(np.float64), found.peaks.along.astype(np.float64)

    ways: list[tuple[str, Callable[[], Points]]] = [
        ("wearline", ours),
        ("thesis", thesis),
        ("centre of gravity", lambda: _gravity(pixels, scale)),
        ("Steger, OpenCV filters", lambda: _steger(pixels, scale)),
    ]
    try:
        from skimage.feature import hessian_matrix, hessian_matrix_eigvals
    except ImportError:
        pass
    else:

        def ridge() -> Points:
            matrix = hessian_matrix(  # type: ignore[no-untyped-call]
                pixels.astype(np.float32), sigma=scale.width_px, use_gaussian_derivatives=False
            )
            strength = -hessian_matrix_eigvals(matrix)[1]  # type: ignore[no-untyped-call]
            return _ridge_tops(np.asarray(strength, np.float32))

        ways.append(("scikit-image ridge", ridge))
    return [_measured(name, way, truth) for name, way in ways]


def _measured(name: str, way: Callable[[], Points], truth: Truth) -> PeerResult:
    times = []
    for _ in range(3):
        start = time.perf_counter()
        row, col = way()
        times.append(time.perf_counter() - start)
    place = np.clip(np.rint(col).astype(np.int64), 0, truth.row_px.shape[1] - 1)
    off = row - truth.row_px[:, place]
    size = np.where(np.isfinite(off), np.abs(off), np.inf)
    line = np.argmin(size, axis=0)
    error = off[line, np.arange(len(row))]
    near = size.min(axis=0) < _NEAR_PX
    taken = np.unique(line[near] * truth.row_px.shape[1] + place[near])
    visible = int(np.isfinite(truth.row_px).sum())
    return PeerResult(
        name, 1e3 * min(times), len(taken) / max(visible, 1), float(np.sqrt(np.mean(error[near] ** 2))),
        len(row) - len(taken),
    )  # fmt: skip


def _gravity(pixels: U8, scale: Scale) -> Points:
    """Centroid of each run above a global threshold: what most scanners do."""
    image = cv2.GaussianBlur(pixels, (0, 0), 0.5 * scale.width_px).T.astype(np.float32)
    level = float(np.median(image)) + 0.25 * float(np.percentile(image, 99.5) - np.median(image))
    above = np.pad((image > level).astype(np.int8), ((0, 0), (1, 1)))
    edges = np.diff(above.reshape(-1))
    start, stop = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    padded = np.pad(np.maximum(image - level, 0.0), ((0, 0), (1, 1))).reshape(-1).astype(np.float64)
    total = np.concatenate([[0.0], np.cumsum(padded)])
    moment = np.concatenate([[0.0], np.cumsum(padded * (np.arange(padded.size) % above.shape[1] - 1.0))])
    weight = total[stop + 1] - total[start + 1]
    good = weight > 0.0
    centre = (moment[stop + 1] - moment[start + 1])[good] / weight[good]
    return centre, (start[good] // above.shape[1]).astype(np.float64)


def _steger(pixels: U8, scale: Scale) -> Points:
    """Steger (doi 10.1109/34.659930): the zero of the first derivative along the eigenvector of the Hessian."""
    image = pixels.astype(np.float32)
    sigma = scale.width_px
    x = np.arange(-round(4 * sigma), round(4 * sigma) + 1, dtype=np.float64)
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    d1, d2 = -x / sigma**2 * g, (x * x / sigma**4 - 1.0 / sigma**2) * g
    # A correlation is the convolution with the mirrored kernel; only the odd one changes its sign.
    gx, gy = (cv2.sepFilter2D(image, cv2.CV_32F, kx, ky) for kx, ky in ((-d1, g), (g, -d1)))
    gxx, gyy, gxy = (cv2.sepFilter2D(image, cv2.CV_32F, kx, ky) for kx, ky in ((d2, g), (g, d2), (-d1, -d1)))
    strong = -gyy > 0.15 * float(np.percentile(-gyy, 99.5))
    row, col = np.nonzero(strong)
    a, b, c = gxx[row, col], gxy[row, col], gyy[row, col]
    root = np.sqrt((0.5 * (a - c)) ** 2 + b * b)
    value = 0.5 * (a + c) - root
    nx, ny = np.where(np.abs(b) > 1e-6, b, 0.0), np.where(np.abs(b) > 1e-6, value - a, 1.0)
    length = np.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    t = -(gx[row, col] * nx + gy[row, col] * ny) / value
    inside = (value < 0) & (np.abs(t * nx) <= 0.5) & (np.abs(t * ny) <= 0.5)
    return (row + t * ny)[inside].astype(np.float64), (col + t * nx)[inside].astype(np.float64)


def _ridge_tops(strength: NDArray[np.float32]) -> Points:
    """Tops of a ridge filter in each column, with the parabola through three pixels."""
    inner, above, below = strength[1:-1], strength[:-2], strength[2:]
    top = (inner > 0.15 * float(np.percentile(strength, 99.5))) & (inner >= above) & (inner > below)
    row, col = np.nonzero(top)
    u, m, d = above[row, col], inner[row, col], below[row, col]
    return row + 1.0 + 0.5 * (u - d) / np.minimum(u + d - 2.0 * m, -1e-6), col.astype(np.float64)
