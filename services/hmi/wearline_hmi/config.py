"""Settings of the web interface."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from wearline.config import Settings


class HmiSettings(Settings):
    """The section `hmi` of cell.yaml."""

    host: str = "127.0.0.1"
    """Where the web server listens; 0.0.0.0 opens it to the plant network."""
    port: int = Field(default=8080, ge=0, le=65535)
    """0 takes any free port."""
    allowed_hosts: tuple[str, ...] = ()
    """Names or addresses, without port, by which browsers may call this server beside `host` and the loopback."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses of proxies whose X-Forwarded-For and X-Forwarded-Proto are believed."""
    tls_certificate: Path | None = None
    """PEM file with the server's certificate and its chain; with `tls_key` the server speaks https alone."""
    tls_key: Path | None = None
    """PEM file with its private key."""
    view_without_login: bool = False
    """Whoever reaches the server may look at the cell without a password, and change nothing. Meant for demonstrations
    and for panels at the press; everything else needs a login in any case."""
    idle_minutes: float = Field(default=60.0, gt=0, le=1440)
    """A login ends when its user did nothing for so long. [min]"""
    session_hours: float = Field(default=12.0, gt=0, le=168)
    """A login ends so long after it began. [h]"""
    forbidden_passwords: Path | None = None
    """Text file with one known password per line, for example a list of breached ones; none of them is taken."""
    title: str = ""
    """Name of the cell on the screen; empty = the name of the cell."""
    stale_after_s: float = Field(default=30.0, gt=0)
    """A verdict older than this is shown as old. [s]"""
    records_period_s: float = Field(default=5.0, gt=0)
    """How often judge is asked for records and trend while nothing happens. [s]"""
    strokes_shown: int = Field(default=12, ge=1, le=100)
    """Rows of the table of last strokes."""

    @model_validator(mode="after")
    def _tls_is_whole(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together; give both or none")
        return self
