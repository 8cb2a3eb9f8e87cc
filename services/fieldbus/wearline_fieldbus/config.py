"""The section ``fieldbus`` of cell.yaml, and ``plc_sim`` beside it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from wearline.config import Settings
from wearline_fieldbus.core.cycle import HandshakeSettings
from wearline_fieldbus.core.profiles import PROFILES, Profile, remapped
from wearline_fieldbus.core.soft_plc import SoftPlcSettings
from wearline_fieldbus.drivers.journal import JournalSettings
from wearline_fieldbus.drivers.s7 import S7Settings


class PlcSettings(S7Settings):
    """Which PLC."""

    kind: Literal["s7", "memory"] = "s7"
    """memory: no PLC yet; only measurements by hand."""


class FieldbusSettings(Settings):
    """The PLC side of the cell."""

    profile: Literal["basic", "extended"] = "basic"
    """The layout of the process image and its handshake."""
    remap: dict[str, str] = Field(default_factory=dict)
    """Field -> address (``12.3`` or ``14``), or ``-`` to leave it out."""
    plc: PlcSettings = PlcSettings()
    handshake: HandshakeSettings = HandshakeSettings()
    journal: JournalSettings = JournalSettings()


class PlcSimSettings(SoftPlcSettings):
    """The simulated PLC: `wearline plc-sim`."""

    profile: Literal["basic", "extended"] = "basic"
    """As fieldbus has it."""

    host: str = "127.0.0.1"
    port: int = Field(default=1102, ge=0, le=65535)
    """0 = any free one; it is printed."""
    db: int = Field(default=100, ge=1, le=65535)
    scan_ms: float = Field(default=10.0, ge=1, le=1000)
    """Between two scans of its program. [ms]"""


def make_profile(settings: FieldbusSettings) -> Profile:
    """The profile as cell.yaml has it.

    Raises:
        ConfigError: a remap that cannot be obeyed.
    """
    return remapped(PROFILES[settings.profile], settings.remap, settings.handshake.numbered, "fieldbus.remap")
