"""The section ``fieldbus`` of cell.yaml, and ``plc_sim`` beside it."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from wearline.config import Settings
from wearline_fieldbus.core.cycle import HandshakeSettings
from wearline_fieldbus.core.profiles import PROFILES, Profile, remapped
from wearline_fieldbus.core.soft_plc import SoftPlcSettings
from wearline_fieldbus.drivers.journal import JournalSettings
from wearline_fieldbus.drivers.modbus import DigitalIoSettings, ModbusSettings
from wearline_fieldbus.drivers.s7 import S7Settings


class PlcSettings(S7Settings):
    """Which PLC."""

    kind: Literal["s7", "s7_server", "modbus", "digital_io", "memory"] = "s7"
    """s7: we read and write the PLC's data block. s7_server: the PLC reads and writes ours (host and port are where we
    listen). modbus: the PLC is a client of our Modbus server. digital_io: eight wires. memory: no PLC yet; only
    measurements by hand."""


class FieldbusSettings(Settings):
    """The PLC side of the cell."""

    profile: Literal["basic", "extended"] = "basic"
    """The layout of the process image and its handshake."""
    remap: dict[str, str] = Field(default_factory=dict)
    """Field -> address (``12.3`` or ``14``), or ``-`` to leave it out."""
    plc: PlcSettings = PlcSettings()
    modbus: ModbusSettings = ModbusSettings()
    digital_io: DigitalIoSettings = DigitalIoSettings()
    handshake: HandshakeSettings = HandshakeSettings()
    journal: JournalSettings = JournalSettings()

    @model_validator(mode="after")
    def _fits_the_plc(self) -> Self:
        if self.plc.kind == "digital_io" and (self.profile != "basic" or self.remap or self.handshake.numbered):
            raise ValueError(
                "eight wires carry no numbers and no words: digital_io goes with profile basic, no remap and "
                "handshake.numbered: false"
            )
        if self.profile == "extended" and not self.handshake.numbered:
            raise ValueError("profile extended is always numbered: leave handshake.numbered true")
        if self.plc.kind == "modbus" and self.modbus.port is None:
            raise ValueError("plc.kind modbus needs modbus.port, the port that the PLC connects to")
        make_profile(self)
        return self


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
