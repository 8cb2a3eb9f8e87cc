"""How long to expose, and whether there is time for it."""

from __future__ import annotations

from pydantic import Field

from wearline.config import Settings
from wearline.errors import FrameError
from wearline.messages import ResultCode


class ExposureSettings(Settings):
    """The light that a frame gets."""

    exposure_us: float = Field(default=10000.0, gt=0)
    """[us]"""
    exposure_min_us: float = Field(default=20.0, gt=0)
    exposure_max_us: float = Field(default=200000.0, gt=0)
    gain_db: float = Field(default=0.0, ge=0, le=24)


def checked_exposure_us(settings: ExposureSettings, wanted_us: float) -> float:
    """The exposure, if the camera can give it. [us]

    Raises:
        ValueError: outside the camera's range.
    """
    if not settings.exposure_min_us <= wanted_us <= settings.exposure_max_us:
        raise ValueError(
            f"exposure {wanted_us:g} us is outside {settings.exposure_min_us:g} to {settings.exposure_max_us:g} us"
        )
    return wanted_us


def checked_gain_db(wanted_db: float) -> float:
    """The gain, if the camera can give it. [dB]

    Raises:
        ValueError: outside 0 to 24 dB.
    """
    if not 0.0 <= wanted_db <= 24.0:
        raise ValueError(f"gain {wanted_db:g} dB is outside 0 to 24 dB")
    return wanted_db


def check_time_left(exposure_us: float, time_left_ms: float) -> None:
    """A frame that cannot be ready before the deadline is not begun: it would show a part that nobody waits for.

    Raises:
        FrameError: code 11.
    """
    if not time_left_ms * 1000.0 > exposure_us:
        raise FrameError(
            f"{time_left_ms:.0f} ms left, exposure takes {exposure_us / 1000.0:.1f} ms",
            "capture",
            "shorten the exposure or lengthen the deadline",
            code=int(ResultCode.NO_FRAME),
        )
