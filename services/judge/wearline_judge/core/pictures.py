"""Maps as bytes of formats that other programs read: 16-bit TIFF, PLY points, and colours for people."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
_ASCII, _SHORT, _LONG = 2, 3, 4


@dataclass(frozen=True)
class Levels:
    """How 16-bit values stand for millimetres: value = (mm - offset) / step + 1; 0 = not measured."""

    step_mm: float
    offset_mm: float

    @property
    def description(self) -> str:
        """What is written into the file."""
        return f"mm = {self.offset_mm:.6f} + (value - 1) * {self.step_mm:.6f}; value 0 = not measured"


def levels_of(map_mm: F32) -> Levels:
    """Steps of 1 um, or the finest that hold the map's range."""
    finite = map_mm[np.isfinite(map_mm)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    return Levels(max(0.001, (high - low) / 65534.0), low)


def tiff16(map_mm: F32) -> bytes:
    """An uncompressed grey TIFF of 16 bits (TIFF 6.0), its levels in ImageDescription.

    Args:
        map_mm: (row, col), NaN = not measured. [mm]
    """
    levels = levels_of(map_mm)
    known = np.isfinite(map_mm)
    scaled = np.where(known, (map_mm.astype(np.float64) - levels.offset_mm) / levels.step_mm + 1.0, 0.0)
    pixels = np.clip(np.rint(scaled), 0, 65535).astype("<u2").tobytes()
    rows, cols = map_mm.shape
    text = levels.description.encode("ascii") + b"\0"
    text += b"\0" * (len(text) % 2)
    entries = 10
    text_at = 8 + 2 + 12 * entries + 4
    pixels_at = text_at + len(text)

    def entry(tag: int, kind: int, count: int, value: int) -> bytes:
        return struct.pack("<HHII", tag, kind, count, value)

    directory = b"".join((
        entry(256, _LONG, 1, cols), entry(257, _LONG, 1, rows), entry(258, _SHORT, 1, 16), entry(259, _SHORT, 1, 1),
        entry(262, _SHORT, 1, 1), entry(270, _ASCII, len(text), text_at), entry(273, _LONG, 1, pixels_at),
        entry(277, _SHORT, 1, 1), entry(278, _LONG, 1, rows), entry(279, _LONG, 1, len(pixels)),
    ))  # fmt: skip
    return b"".join((b"II*\0", struct.pack("<IH", 8, entries), directory, struct.pack("<I", 0), text, pixels))


def ply(x_mm: F32, y_mm: F32, z_mm: F32, names: tuple[str, ...], columns: tuple[F32, ...], comment: str) -> bytes:
    """A cloud of points as binary PLY 1.0: x, y, z and further properties, all float; equal lengths."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment {' '.join(comment.split())}\nelement vertex {len(z_mm)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", *names))
        + "end_header\n"
    )
    return head.encode("ascii", "replace") + np.column_stack([x_mm, y_mm, z_mm, *columns]).astype("<f4").tobytes()


_STOPS = np.array([[59, 76, 192], [141, 176, 254], [221, 221, 221], [244, 152, 122], [180, 4, 38]], np.float64)
"""Moreland's cool-warm map (doi:10.1007/978-3-642-10520-3_9): blue below, grey at zero, red above."""
_UNKNOWN = (40, 40, 44)


def colours(map_mm: F32, low_mm: float, high_mm: float) -> NDArray[np.uint8]:
    """(row, col, rgb) of a map between two values; dark where it was not measured."""
    known = np.isfinite(map_mm)
    share = np.clip((np.where(known, map_mm, low_mm) - low_mm) / max(high_mm - low_mm, 1e-9), 0.0, 1.0)
    place = share * (len(_STOPS) - 1)
    below = np.minimum(place.astype(np.int64), len(_STOPS) - 2)
    part = (place - below)[..., None]
    rgb = _STOPS[below] * (1.0 - part) + _STOPS[below + 1] * part
    return np.where(known[..., None], np.rint(rgb), _UNKNOWN).astype(np.uint8)
