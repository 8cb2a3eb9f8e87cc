"""The section ``reconstruct`` of cell.yaml."""

from __future__ import annotations

from wearline.config import Settings
from wearline_reconstruct.core.calibration import CalibrationSettings
from wearline_reconstruct.core.chain import ChainSettings
from wearline_reconstruct.core.lines import LineSettings
from wearline_reconstruct.core.numbering import NumberingSettings
from wearline_reconstruct.core.smoothing import SmoothingSettings
from wearline_reconstruct.core.stripes import StripeSettings
from wearline_reconstruct.core.thesis import ThesisSettings


class ReconstructSettings(Settings):
    """How frames become heights."""

    stripes: StripeSettings = StripeSettings()
    lines: LineSettings = LineSettings()
    numbering: NumberingSettings = NumberingSettings()
    smoothing: SmoothingSettings = SmoothingSettings()
    thesis: ThesisSettings = ThesisSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    step_in_after_s: float = 0.4
    """With several replicas: the second one for a frame measures it when the first one is so late. [s]"""
    ask_timeout_s: float = 0.5
    """How long judge may take to answer for a recipe or an artifact. [s]"""

    @property
    def chain(self) -> ChainSettings:
        """The settings of the measuring chain."""
        return ChainSettings(self.stripes, self.lines, self.numbering, self.smoothing, self.thesis)
