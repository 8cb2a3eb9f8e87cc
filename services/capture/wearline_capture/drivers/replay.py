"""A folder of images, in the order of their names."""

from __future__ import annotations

import re
import threading
from pathlib import Path

from wearline.config import Settings
from wearline.errors import ConfigError, DeviceError, FrameError
from wearline.messages import MeasureRequest, ResultCode
from wearline.offline import read_frame
from wearline_capture.drivers.camera import Shot

_SUFFIXES = {".png", ".bmp", ".pgm", ".tif", ".tiff", ".jpg", ".jpeg"}


class ReplaySettings(Settings):
    """Where the images are."""

    folder: Path | None = None
    """Relative to the cell's data_dir."""
    loop: bool = True
    """Begin again after the last image; without it there are no frames from then on."""


def _in_order(path: Path) -> list[tuple[int, int, str]]:
    """Sorts frame_9 before frame_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name) if part]


class ReplayCamera:
    """Every request gets the next image. What it shows was measured once, not now: it counts as simulated."""

    name = "replay"
    is_simulated = True

    def __init__(self, folder: Path, *, loop: bool = True) -> None:
        """Lists the folder once.

        Raises:
            ConfigError: no such folder, or no image in it.
        """
        if not folder.is_dir():
            raise ConfigError("is no folder", str(folder), "set capture.folder to a folder of images")
        self._images = sorted((p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES), key=_in_order)
        if not self._images:
            raise ConfigError("holds no image", str(folder), "put PNG, BMP, PGM, TIFF or JPEG files there")
        self._folder = folder
        self._loop = loop
        self._counter = 0
        self._closed = threading.Event()

    def shoot(self, request: MeasureRequest, exposure_us: float, gain_db: float) -> Shot:
        if self._counter >= len(self._images) and not self._loop:
            raise FrameError(
                f"all {len(self._images)} images are used",
                str(self._folder),
                "set capture.loop or add images",
                code=int(ResultCode.NO_FRAME),
            )
        image = self._images[self._counter % len(self._images)]
        self._counter += 1
        if self._closed.wait(exposure_us * 1e-6):
            raise DeviceError("closed during the exposure", self.name)
        return Shot(read_frame(image), exposure_us, self._counter)

    def figures(self) -> dict[str, float | int | str | bool | None]:
        return {"images": len(self._images), "images_used": self._counter}

    def close(self) -> None:
        self._closed.set()
