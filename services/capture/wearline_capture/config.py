"""The section ``capture`` of cell.yaml."""

from __future__ import annotations

from typing import Literal

from wearline_capture.core.exposure import ExposureSettings
from wearline_capture.core.preview import PreviewSettings
from wearline_capture.drivers.replay import ReplaySettings
from wearline_capture.drivers.sim import SimSettings


class CaptureSettings(ExposureSettings, PreviewSettings, SimSettings, ReplaySettings):
    """Which camera, and how it is set."""

    kind: Literal["sim", "replay"] = "sim"
    camera: str = ""
    """Name of the camera in every frame; empty = its kind."""
