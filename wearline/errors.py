"""The error tree. Every text names what is wrong, where, and the cure.

WearlineError
├── UsageError           an option or a combination of options
├── ConfigError          cell.yaml
├── RecipeError          a recipe file
├── MessageError         a message that is not what its topic says
├── BusError             no router, no answer
├── FrameError           an image that cannot be measured (carries a result code)
├── CalibrationError     calibration missing, broken or refused
├── TemplateError        template missing, broken or refused
├── RecordError          records, journal, store
└── DeviceError          a camera or PLC that does not answer
"""

from __future__ import annotations


class WearlineError(Exception):
    """Base of all errors that a user may see; ``str(error)`` is one line."""

    def __init__(self, what: str, where: str = "", cure: str = "") -> None:
        self.what, self.where, self.cure = what, where, cure
        text = f"{where}: {what}" if where else what
        super().__init__(" ".join(f"{text}; {cure}".split()) if cure else " ".join(text.split()))


class UsageError(WearlineError):
    """An option, or a combination of options, that cannot be obeyed."""


class ConfigError(WearlineError):
    """A cell.yaml that cannot be obeyed."""


class RecipeError(WearlineError):
    """A recipe that cannot be obeyed."""


class MessageError(WearlineError):
    """A message that is not what its topic promises."""


class BusError(WearlineError):
    """The bus gave no answer."""


class FrameError(WearlineError):
    """An image that cannot be measured.

    ``code`` is the result code (10-99) that the PLC is told.
    """

    def __init__(self, what: str, where: str = "", cure: str = "", code: int = 12) -> None:
        super().__init__(what, where, cure)
        self.code = code


class CalibrationError(WearlineError):
    """A calibration that is missing, broken or refused."""


class TemplateError(WearlineError):
    """A template that is missing, broken or refused."""


class RecordError(WearlineError):
    """Records, journal or store that cannot be read or written."""


class DeviceError(WearlineError):
    """A camera or PLC that does not answer."""
