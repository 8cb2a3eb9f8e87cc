"""The section ``judge`` of cell.yaml."""

from __future__ import annotations

from pydantic import Field

from wearline_judge.core.alarms import AlarmSettings
from wearline_judge.core.judgement import JudgingSettings
from wearline_judge.drivers.frames import FrameSettings
from wearline_judge.drivers.room import RoomSettings


class JudgeSettings(JudgingSettings, FrameSettings, RoomSettings):
    """How parts are judged, and where the records lie."""

    records_url: str | None = None
    """``sqlite:///FILE`` or ``postgresql://USER:PASSWORD@HOST/DATABASE``; None = SQLite in the data folder."""
    records_kept: int | None = Field(default=None, ge=1)
    """Records beyond this many are pruned, the oldest first; a signed checkpoint stands for them. None = keep all."""
    alarms: AlarmSettings = AlarmSettings()
    teach_frames: int = Field(default=5, ge=1, le=100)
    """Parts that make a template when the next ones are taught."""
    view_longest: int = Field(default=160, ge=16, le=1024)
    """Elements along the longer side of the maps for the eye."""
