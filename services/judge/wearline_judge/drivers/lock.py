"""One writer for one folder."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from wearline.errors import RecordError


class FolderLock:
    """Held from its making to `close`, or to the end of the process, however it ends."""

    def __init__(self, folder: Path) -> None:
        """Take it.

        Raises:
            RecordError: another process has it.
        """
        self._file = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            raise RecordError("is used by a running judge", str(folder), "stop it, or mend data_dir") from error

    def close(self) -> None:
        """Let others have it."""
        os.close(self._file)
