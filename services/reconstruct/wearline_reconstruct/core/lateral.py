"""Where points lie beside each other: a flat target on z = 0, seen once, gives camera, pose, x and y in mm.

The target is a chessboard or a grid of dots of any size. One view of a plane that the camera sees
nearly squarely does not tell focal length from distance, so that the distance comes from the height
calibration (a / b of equation 4-6) and OpenCV fits distortion and pose; what remains of it is the
scale of points high above the datum, z / distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration
from wearline.errors import CalibrationError
from wearline_reconstruct.core.stripes import F64

U8 = NDArray[np.uint8]
_CURE = "show the whole target flat on z = 0, sharp, evenly lit, laser off"
_LARGEST_RMS_PX = 1.0
_LEAST_POINTS = 12


@dataclass(frozen=True)
class Target:
    """A target found in a picture."""

    kind: str
    image_px: F64
    """(n, 2): x, y. [px]"""
    grid: F64
    """(n, 2): whole numbers of fields along and across."""


def find_target(grey: U8, where: str) -> Target:
    """A chessboard's inner corners, or the dots of a grid.

    Raises:
        CalibrationError: neither is there.
    """
    dots = _dots(grey)
    grid, kept = _lattice(dots)
    if _is_whole(kept, dots):
        return _upright("dots", dots[kept], grid)
    corners = _corners(grey)
    grid, kept = _lattice(corners)
    if _is_whole(kept, corners):
        return _upright("corners", corners[kept], grid)
    raise CalibrationError("shows neither a chessboard nor a grid of dots", where, _CURE)


def _is_whole(kept: NDArray[np.int64], points: F64) -> bool:
    return len(kept) >= _LEAST_POINTS and len(kept) > 0.5 * len(points)


def _corners(grey: U8) -> F64:
    """Where four fields of a chessboard meet: saddle points of the grey values, sub-pixel. [px]

    Any size and any part of a board will do, which the board finders of OpenCV do not promise.
    """
    best, best_score = np.zeros((0, 2)), 0.0
    for sigma in (2.0, 3.5):
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma)
        xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, dx, dy, ksize=3) for dx, dy in ((2, 0), (0, 2), (1, 1)))
        saddle = xy * xy - xx * yy
        reach = round(3.0 * sigma)
        is_top = saddle >= cv2.dilate(saddle, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        level = float(np.partition(saddle[is_top], -min(20, int(is_top.sum())))[-min(20, int(is_top.sum()))])
        is_top &= saddle > max(0.3 * level, 1.0)
        is_top[:reach] = is_top[-reach:] = False
        is_top[:, :reach] = is_top[:, -reach:] = False
        row, col = np.nonzero(is_top)
        if not _LEAST_POINTS <= len(row) <= 4000:
            continue
        row, col = _crossings(smooth, row, col, 2.0 * sigma)
        if not _LEAST_POINTS <= len(row) <= 4000:
            continue
        start = np.ascontiguousarray(np.stack([col, row], axis=1)[:, None], np.float32)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.005)
        points = np.asarray(cv2.cornerSubPix(grey, start, (5, 5), (-1, -1), stop), np.float64)[:, 0]
        score = float(len(_lattice(points)[1])) / len(points) * np.sqrt(len(points))
        if score > best_score:
            best, best_score = points, score
    return best


def _crossings(
    smooth: NDArray[Any], row: NDArray[np.int64], col: NDArray[np.int64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places with two dark and two bright fields about them: the second harmonic of a ring rules, not the first."""
    turn = np.arange(16) * (2.0 * np.pi / 16.0)
    x = (col[:, None] + radius * np.cos(turn)).astype(np.float32)
    y = (row[:, None] + radius * np.sin(turn)).astype(np.float32)
    ring = cv2.remap(np.asarray(smooth, np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    first, second = (np.abs(ring @ np.exp(1j * k * turn)) for k in (1, 2))
    good = first < 0.4 * second
    return row[good], col[good]


def _upright(kind: str, image_px: F64, grid: F64) -> Target:
    """Fields counted so that the first axis runs along x and the second along y of the picture."""
    for _ in range(4):
        fit = np.linalg.lstsq(np.column_stack([grid, np.ones(len(grid))]), image_px, rcond=None)[0]
        if abs(fit[0, 0]) < abs(fit[0, 1]):
            grid = grid[:, ::-1]
            continue
        grid = grid * np.sign([fit[0, 0], fit[1, 1]])
    across, along = (np.ptp(grid, axis=0) + 1).astype(int)
    name = "dot target" if kind == "dots" else "chessboard"
    return Target(f"{name}, {across} x {along} {kind}", image_px, grid - grid.min(axis=0))


def _dots(grey: U8) -> F64:
    """Centres of round blobs of like size, dark on bright or bright on dark. [px]"""
    best = np.zeros((0, 2))
    smooth: U8 = np.asarray(cv2.GaussianBlur(grey, (5, 5), 0), np.uint8)
    block = max(grey.shape) // 12 | 1
    for kind in (cv2.THRESH_BINARY, cv2.THRESH_BINARY_INV):
        mask = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, block, -6 if kind == 0 else 6)
        contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        found = []
        for contour in contours:
            area, around = cv2.contourArea(contour), cv2.arcLength(contour, True)
            if area > 20.0 and 4.0 * np.pi * area > 0.82 * around * around:
                found.append((area, *_centre(smooth, contour)))
        if not found:
            continue
        blobs = np.array(found)
        # One target's dots are alike; the picture's tilt changes them by little.
        usual = np.median(blobs[:, 0])
        alike = blobs[(blobs[:, 0] > 0.5 * usual) & (blobs[:, 0] < 2.0 * usual), 1:]
        if len(alike) > len(best):
            best = alike
    return best


def _centre(grey: U8, contour: Any) -> tuple[float, float]:
    """Centroid of a dot's own light, weighed against its surroundings: finer than its outline."""
    x, y, width, height = cv2.boundingRect(contour)
    pad = max(2, width // 4)
    x0, y0 = max(x - pad, 0), max(y - pad, 0)
    window = grey[y0 : y + height + pad, x0 : x + width + pad].astype(np.float64)
    rim = np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]])
    weight = np.abs(window - np.median(rim))
    weight[weight < 0.15 * weight.max()] = 0.0
    total = max(float(weight.sum()), 1e-9)
    return (
        x0 + float(weight.sum(axis=0) @ np.arange(weight.shape[1])) / total,
        y0 + float(weight.sum(axis=1) @ np.arange(weight.shape[0])) / total,
    )


def _lattice(points: F64) -> tuple[F64, NDArray[np.int64]]:
    """Whole-number places of points of a square grid, grown from the middle one: grid (m, 2) and indices (m,)."""
    if len(points) < _LEAST_POINTS:
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    middle = int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    away = points - points[middle]
    near = np.argsort(np.linalg.norm(away, axis=1))[1:9]
    first = away[near[0]]
    across = [away[k] for k in near if abs(float(away[k] @ first)) < 0.3 * float(first @ first)
              and float(np.linalg.norm(away[k])) < 1.3 * float(np.linalg.norm(first))]  # fmt: skip
    if not across:
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    steps = np.stack([first, across[0]])
    place: dict[tuple[int, int], int] = {(0, 0): middle}
    taken = {middle}
    front = [(0, 0)]
    while front:
        cell = front.pop(0)
        here = points[place[cell]]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            target = (cell[0] + sign, cell[1]) if axis == 0 else (cell[0], cell[1] + sign)
            if target in place:
                continue
            # The step to the opposite neighbour follows the picture's perspective.
            back = (cell[0] - sign, cell[1]) if axis == 0 else (cell[0], cell[1] - sign)
            step = here - points[place[back]] if back in place else sign * steps[axis]
            distance = np.linalg.norm(points - (here + step), axis=1)
            nearest = int(np.argmin(distance))
            if distance[nearest] < 0.25 * float(np.linalg.norm(step)) and nearest not in taken:
                place[target] = nearest
                taken.add(nearest)
                front.append(target)
    cells = np.array(list(place), np.float64)
    return cells, np.array(list(place.values()), np.int64)


def fit_lateral(
    target: Target, field_mm: float, shape: tuple[int, int], distance_mm: float, where: str
) -> dict[str, Any]:
    """Camera and pose from a target on z = 0: JSON values for `Calibration.meta`.

    Args:
        field_mm: edge of one chessboard field, or distance of neighbouring dots.
        shape: rows, cols of the sensor.
        distance_mm: of the camera from the datum, by the height calibration.

    Raises:
        CalibrationError: the target is not flat, not square, or seen too much from the side.
    """
    rows, cols = shape
    world = np.column_stack([target.grid * field_mm, np.zeros(len(target.grid))]).astype(np.float32)
    image = target.image_px.astype(np.float32)
    steps = np.linalg.lstsq(np.column_stack([target.grid, np.ones(len(image))]), target.image_px, rcond=None)[0][:2]
    focal = distance_mm * float(np.linalg.norm(steps, axis=1).mean()) / field_mm
    matrix = np.array([[focal, 0.0, 0.5 * (cols - 1)], [0.0, focal, 0.5 * (rows - 1)], [0.0, 0.0, 1.0]])
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    )  # fmt: skip
    # Beyond the target nothing holds the distortion: a small one must not bend the rim of the picture.
    covered = float(np.prod(np.ptp(target.image_px, axis=0))) / (rows * cols)
    if covered < 0.5 or len(image) < 40:
        flags |= cv2.CALIB_FIX_K2
    if covered < 0.15:
        flags |= cv2.CALIB_FIX_K1
    rms, matrix, distortion, turns, moves = cv2.calibrateCamera(
        [world], [image], (cols, rows), matrix, np.zeros(5), flags=flags
    )
    if not np.isfinite(rms) or rms > _LARGEST_RMS_PX:
        raise CalibrationError(f"target fits a flat grid only to {rms:.2f} px", where, _CURE)
    turn, _ = cv2.Rodrigues(turns[0])
    tilt = float(np.degrees(np.arccos(np.clip(abs(turn[2, 2]), 0.0, 1.0))))
    if tilt > 20.0:
        raise CalibrationError(f"target is tilted by {tilt:.0f} degrees", where, "lay it flat on z = 0")
    return {
        "target": target.kind, "rms_px": round(float(rms), 4), "tilt_deg": round(tilt, 3),
        "focal_px": float(matrix[0, 0]), "centre_px": [float(matrix[0, 2]), float(matrix[1, 2])],
        "distortion": [float(v) for v in np.ravel(distortion)[:5]],
        "rotation": [float(v) for v in np.ravel(turns[0])], "translation_mm": [float(v) for v in np.ravel(moves[0])],
    }  # fmt: skip


def scale_of(lateral: dict[str, Any], shape: tuple[int, int]) -> float:
    """mm per pixel on z = 0 about the middle of the sensor."""
    row, col = 0.5 * (shape[0] - 1), 0.5 * (shape[1] - 1)
    x, y = _on_plane(lateral, np.array([col - 50, col + 50, col, col]), np.array([row, row, row - 50, row + 50]), 0.0)
    across, along = np.hypot(x[1] - x[0], y[1] - y[0]), np.hypot(x[3] - x[2], y[3] - y[2])
    return float(0.5 * (across + along) / 100.0)


def positions_mm(calibration: Calibration, row_px: F64, col_px: F64, z_mm: F64) -> tuple[F64, F64]:
    """x (with the columns) and y (with the rows) of measured points, 0 in the middle of the sensor. [mm]

    With a target by camera and pose; with a bare scale by that scale on every height. NaN without either.
    """
    rows, cols = (int(v) for v in calibration.image_shape)
    row0, col0 = 0.5 * (rows - 1), 0.5 * (cols - 1)
    lateral = calibration.meta.get("lateral")
    if not lateral:
        return (col_px - col0) * calibration.mm_per_pixel, (row_px - row0) * calibration.mm_per_pixel
    x, y = _on_plane(lateral, np.append(col_px, [col0, col0 + 100.0]), np.append(row_px, [row0, row0]),
                     np.append(z_mm, [0.0, 0.0]))  # fmt: skip
    # Turned so that x runs along the sensor's rows, however the target lay.
    turn = np.arctan2(y[-1] - y[-2], x[-1] - x[-2])
    dx, dy = x[:-2] - x[-2], y[:-2] - y[-2]
    return np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx


def _on_plane(lateral: dict[str, Any], col: F64, row: F64, z_mm: F64 | float) -> tuple[F64, F64]:
    """Where lines of sight meet the plane at z over the target, in the target's own frame. [mm]"""
    focal, centre = lateral["focal_px"], lateral["centre_px"]
    matrix = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    seen = np.stack([col, row], axis=1).astype(np.float64)[:, None]
    flat = np.asarray(cv2.undistortPoints(seen, matrix, np.array(lateral["distortion"])), np.float64).reshape(-1, 2)
    turn, _ = cv2.Rodrigues(np.array(lateral["rotation"]))
    eye = -turn.T @ np.array(lateral["translation_mm"])
    sight = np.column_stack([flat, np.ones(len(flat))]) @ turn
    # x to the right and y downwards: the target's own z points away from the camera.
    reach = (-np.asarray(z_mm) - eye[2]) / sight[:, 2]
    return np.asarray(eye[0] + reach * sight[:, 0]), np.asarray(eye[1] + reach * sight[:, 1])


def distance_mm(calibration: Calibration) -> float:
    """Of the camera from the datum, by the curvature of heights (s = a / b of equation 4-6), within what is usual."""
    a = float(np.nanmedian(calibration.a_mm_per_px))
    found = a / calibration.b_per_px if calibration.b_per_px else float("inf")
    return float(np.clip(found, 200.0, 2500.0)) if found > 0.0 else 700.0
