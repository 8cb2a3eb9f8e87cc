"""Room on the disk of the records: low, nothing new is accepted, and a reserve carries the cycles in flight."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from wearline.config import Settings


class RoomSettings(Settings):
    """When the disk counts as full."""

    min_free_mb: float = Field(default=64.0, ge=0)
    """With less free space than this on the disk of the records Ready is withdrawn. [MB]"""
    reserve_mb: float = Field(default=8.0, ge=0)
    """Held by a file, and freed for the cycles that are under way when the disk fills up. [MB]"""


def free_bytes(folder: Path) -> int:
    """What is left to an ordinary user. [bytes]"""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


class Room:
    """The disk of one folder."""

    def __init__(self, folder: Path, settings: RoomSettings, free: Callable[[Path], int] = free_bytes) -> None:
        self._folder, self._free = folder, free
        self._min_bytes, self._reserve_bytes = int(settings.min_free_mb * 1e6), int(settings.reserve_mb * 1e6)
        self._reserve = folder / "reserve"

    def has_room(self) -> bool:
        """Whether a new cycle may be accepted; holds the reserve again when there is room for it."""
        try:
            held = self._reserve.stat().st_size if self._reserve.exists() else 0
            missing = max(self._reserve_bytes - held, 0)
            if self._free(self._folder) - missing < self._min_bytes:
                return False
            if missing:
                self._hold()
        except OSError:
            # A disk that cannot be asked or written cannot be relied on.
            return False
        return True

    def is_low(self) -> bool:
        """Whether the disk is so full that nothing may be written that can be spared."""
        try:
            return self._free(self._folder) < self._min_bytes + self._reserve_bytes
        except OSError:
            return True

    def free_reserve(self) -> bool:
        """Give the reserve to what must be written now; False where there is none."""
        try:
            self._reserve.unlink()
        except OSError:
            return False
        return True

    def _hold(self) -> None:
        file = os.open(self._reserve, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.posix_fallocate(file, 0, self._reserve_bytes)
        except OSError:
            self._reserve.unlink(missing_ok=True)
            raise
        finally:
            os.close(file)
