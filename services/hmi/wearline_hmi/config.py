"""Settings of the web interface."""

from __future__ import annotations

from pydantic import Field

from wearline.config import Settings


class HmiSettings(Settings):
    """The section `hmi` of cell.yaml."""

    host: str = "127.0.0.1"
    """Where the web server listens; 0.0.0.0 opens it to the plant network."""
    port: int = Field(default=8080, ge=0, le=65535)
    """0 takes any free port."""
    allowed_hosts: tuple[str, ...] = ()
    """Names or addresses, without port, by which browsers may call this server beside `host` and the loopback."""
    title: str = ""
    """Name of the cell on the screen; empty = the name of the cell."""
    stale_after_s: float = Field(default=30.0, gt=0)
    """A verdict older than this is shown as old. [s]"""
    records_period_s: float = Field(default=5.0, gt=0)
    """How often judge is asked for records and trend while nothing happens. [s]"""
    strokes_shown: int = Field(default=12, ge=1, le=100)
    """Rows of the table of last strokes."""
