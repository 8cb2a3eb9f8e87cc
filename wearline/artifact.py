"""Calibration and template: the files that two services read, immutable, named by content hash.

Both are ``.npz`` archives without pickles. Line numbers index the first axis, the coordinate
along the lines (column for horizontal lines, row for vertical ones) the second; ``across`` is
the other sensor coordinate. NaN = not known there.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from wearline.errors import CalibrationError, TemplateError, WearlineError

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


def content_hash(content: bytes) -> str:
    """sha256, hex."""
    return hashlib.sha256(content).hexdigest()


@dataclass(frozen=True, kw_only=True)
class _Artifact:
    """Arrays and one JSON `meta` in an npz; bytes are a pure function of the content."""

    FORMAT: ClassVar[str]
    ERROR: ClassVar[type[WearlineError]]

    meta: dict[str, Any] = field(default_factory=dict)
    """Small facts for people and checks: JSON values only."""

    def to_bytes(self) -> bytes:
        """Serialise; equal content gives equal bytes (fixed order, no time stamps)."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for entry in fields(self):
                value = getattr(self, entry.name)
                if entry.name == "meta":
                    value = np.array(json.dumps({**value, "format": self.FORMAT}, sort_keys=True))
                member = io.BytesIO()
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
                info = zipfile.ZipInfo(f"{entry.name}.npy", (1980, 1, 1, 0, 0, 0))
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, member.getvalue())
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes, where: str) -> Self:
        """Rebuild.

        Raises:
            CalibrationError or TemplateError: not such a file.
        """
        names = {entry.name for entry in fields(cls)}
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                found = {name: archive[name] for name in archive.files}
            meta = json.loads(str(found.pop("meta")))
            if meta.pop("format", None) != cls.FORMAT or set(found) | {"meta"} != names:
                raise ValueError(f"it is no {cls.FORMAT}")
        except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError, zipfile.LargeZipFile) as error:
            raise cls.ERROR(f"cannot be used ({' '.join(str(error).split())})", where, cls._cure()) from error
        return cls(meta=meta, **{k: v[()] if v.ndim == 0 else v for k, v in found.items()})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            CalibrationError or TemplateError: unreadable or not such a file.
        """
        try:
            content = path.read_bytes()
        except OSError as error:
            raise cls.ERROR(f"cannot be read ({error.strerror})", str(path), cls._cure()) from error
        return cls.from_bytes(content, str(path))

    def save(self, path: Path) -> str:
        """Write a file and return its content hash."""
        content = self.to_bytes()
        path.write_bytes(content)
        return content_hash(content)

    @classmethod
    def _cure(cls) -> str:
        return f"make one with 'wearline {cls.FORMAT.split('.')[1]}'"


@dataclass(frozen=True, kw_only=True)
class Calibration(_Artifact):
    """Pixels to mm for one head: z = a d / (1 + b d), d = across - across0 (thesis eq. 4-6, towards the camera).

    ``a_mm_per_px`` and ``across0_px`` are smooth along each line, ``b_per_px`` is one number
    per head.
    """

    FORMAT = "wearline.calibrate.v1"
    ERROR = CalibrationError

    a_mm_per_px: F64
    """(line, along). [mm/px]"""
    across0_px: F64
    """(line, along): where the line lies at z = 0; NaN beyond what the planes showed. [px]"""
    b_per_px: float
    """[1/px]"""
    z_sigma_mm: F64
    """(line, along): standard uncertainty that the calibration itself adds to a height. [mm]"""
    z_range_mm: F64
    """(2,): heights that the planes covered, with the margin within which a height is valid. [mm]"""
    image_shape: NDArray[np.int64]
    """(2,): rows, cols of the sensor."""
    is_vertical: bool
    """Lines run along rows' direction (vertical stripes)."""
    spot_px: F64
    """(2,): row, col of the centre spot at z = 0; NaN without one. [px]"""
    stripe_width_px: float
    """Gaussian sigma of a stripe, median over the calibration frames. [px]"""
    noise: F64
    """(4,): read noise [DN], gain [DN per electron], speckle contrast, speckle correlation length [px]."""
    mm_per_pixel: float
    """Lateral scale on the z = 0 plane; NaN when not known. [mm/px]"""

    @property
    def lines(self) -> int:
        return int(self.a_mm_per_px.shape[0])


@dataclass(frozen=True, kw_only=True)
class Template(_Artifact):
    """The golden part: line points (what decisions are made on) and a dense map (for gating, showing, area)."""

    FORMAT = "wearline.template.v1"
    ERROR = TemplateError

    line_across_px: F32
    """(line, along): mean peak across the lines. [px]"""
    line_z_mm: F32
    """(line, along): mean height. [mm]"""
    line_sigma_mm: F32
    """(line, along): standard uncertainty of line_z_mm. [mm]"""
    line_spread_mm: F32
    """(line, along): standard deviation among the golden parts. [mm]"""
    line_coverage: F32
    """(line, along): share of the golden frames that showed the point, 0-1."""
    z_map_mm: F32
    """(row, col) within the ROI, on every sensor pixel. [mm]"""
    roi: NDArray[np.int32]
    """(4,): x, y, width, height. [px]"""
    calibration_hash: str
    recipe_hash: str
    frames: int
    """Golden frames used."""
