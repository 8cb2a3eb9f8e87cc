"""The section ``judge`` of cell.yaml."""

from __future__ import annotations

from pydantic import Field

from wearline_judge.core.judgement import JudgingSettings
from wearline_judge.drivers.frames import FrameSettings


class JudgeSettings(JudgingSettings, FrameSettings):
    """How parts are judged, and where the records lie."""

    records_url: str | None = None
    """``sqlite:///FILE`` or ``postgresql://USER:PASSWORD@HOST/DATABASE``; None = SQLite in the data folder."""
    records_kept: int | None = Field(default=None, ge=1)
    """Records beyond this many are pruned, the oldest first; a signed checkpoint stands for them. None = keep all."""
    teach_frames: int = Field(default=5, ge=1, le=100)
    """Parts that make a template when the next ones are taught."""
    view_longest: int = Field(default=160, ge=16, le=1024)
    """Elements along the longer side of the maps for the eye."""
    reserve_mb: float = Field(default=256.0, ge=0)
    """With less free space than this on the disk of the records nothing new is accepted. [MB]"""
