"""What every camera does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wearline.messages import MeasureRequest


@dataclass(frozen=True)
class Shot:
    """One image as the camera gave it."""

    pixels: NDArray[np.uint8]
    """Grey values [row, col], full sensor."""
    exposure_us: float
    counter: int
    """Of the camera; a gap is a lost frame."""


class Camera(Protocol):
    """A camera that is triggered by software, one shot per request, on one thread."""

    name: str
    is_simulated: bool

    def shoot(self, request: MeasureRequest, exposure_us: float, gain_db: float) -> Shot:
        """Expose now and wait for the image.

        Raises:
            DeviceError: the camera does not answer or lost the image.
            FrameError: there is an image that cannot be measured, or none; carries the code.
        """
        ...

    def figures(self) -> dict[str, float | int | str | bool | None]:
        """The camera's own figures, for the eye."""
        ...

    def close(self) -> None:
        """Free the device; a shot in progress ends at once."""
        ...
