"""What browsers get: the web server, who may call it, and the pages."""

from __future__ import annotations

import os
from pathlib import Path

from wearline_hmi.service import HmiService, Web


def open_web(service: HmiService, folder: Path) -> Web:
    """Start the web server of one service; `folder` is the service's own.

    Raises:
        ConfigError: the address cannot be listened on, or a file of the settings cannot be read.
        RecordError: the users cannot be read.
    """
    # NiceGUI reads this when it is imported, and would else write into the folder that the process was started in.
    os.environ["NICEGUI_STORAGE_PATH"] = str(folder / "nicegui")
    from wearline_hmi.pages.web import serve

    return serve(service, folder)
