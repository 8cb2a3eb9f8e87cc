"""The web server: one thread with an event loop of its own, beside the loop that handles messages."""

from __future__ import annotations

import logging
import socket
import threading
import time
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import core, run, ui
from starlette.staticfiles import StaticFiles

from wearline.errors import ConfigError, WearlineError
from wearline_hmi.core import rights
from wearline_hmi.drivers.accounts import Accounts
from wearline_hmi.drivers.hashing import Hasher
from wearline_hmi.pages.api import make_api
from wearline_hmi.pages.camera import build_camera
from wearline_hmi.pages.frame import Site
from wearline_hmi.pages.gate import Doorkeeper, Gate, add_gate
from wearline_hmi.pages.help import build_help
from wearline_hmi.pages.live import add_live
from wearline_hmi.pages.log import add_log_export, build_log
from wearline_hmi.pages.measurement import build_measurement
from wearline_hmi.pages.overview import build_overview
from wearline_hmi.pages.production import add_export, build_production
from wearline_hmi.pages.settings import build_settings
from wearline_hmi.pages.shield import Shield
from wearline_hmi.pages.users import build_users
from wearline_hmi.service import HmiService

LOG = logging.getLogger(__name__)
STATIC = Path(__file__).parent / "static"
START_S = 15.0
STOP_S = 0.8
RECONNECT_S = 30.0
"""A panel that stalls for some seconds on a big picture is no lost client. [s]"""


class WebServer:
    """Serves until `close`; no fault of it reaches the service."""

    def __init__(self, app: FastAPI, listener: socket.socket, keeper: Doorkeeper) -> None:
        settings = keeper.settings
        host, port = listener.getsockname()[:2]
        scheme = "http" if settings.tls_certificate is None else "https"
        self.address = f"{scheme}://{host}:{port}" if ":" not in host else f"{scheme}://[{host}]:{port}"
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=0,
            # What a browser sends over the socket is small: clicks and texts.
            ws_max_size=2**20,
            limit_concurrency=500,
            proxy_headers=bool(settings.trusted_proxies),
            forwarded_allow_ips=list(settings.trusted_proxies),
            ssl_certfile=settings.tls_certificate,
            ssl_keyfile=settings.tls_key,
        )
        self._listener, self._keeper = listener, keeper
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._listener])
        except Exception:
            LOG.exception("the web server ended")

    def wait_started(self, timeout_s: float) -> bool:
        """Whether it serves."""
        deadline_s = time.monotonic() + timeout_s
        while not self._server.started and self._thread.is_alive() and time.monotonic() < deadline_s:
            self._thread.join(0.02)
        return self._server.started

    def is_running(self) -> bool:
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop serving and free the port."""
        self._server.should_exit = True
        self._thread.join(STOP_S / 2)
        if self._thread.is_alive():
            self._server.force_exit = True
            self._thread.join(STOP_S / 2)
        self._listener.close()
        self._keeper.hasher.close()
        self._keeper.accounts.close()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        raise ConfigError(
            f"the web server cannot listen there ({error.strerror or error})",
            f"hmi: {host} port {port}",
            "free the port or change hmi.host and hmi.port in cell.yaml",
        ) from error
    return listener


def _forbidden(path: Path | None) -> frozenset[str]:
    """Known passwords, in lower case.

    Raises:
        ConfigError: the file cannot be read.
    """
    if path is None:
        return frozenset()
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ConfigError(
            f"cannot be read ({error.strerror or error})", "hmi.forbidden_passwords", "name an existing text file"
        ) from error
    return frozenset(line.strip().casefold() for line in text.splitlines() if line.strip())


def make_app(service: HmiService, keeper: Doorkeeper) -> FastAPI:
    """All routes of one service; once in a process, as NiceGUI has one application."""
    app = FastAPI(title="Wearline", openapi_url=None, docs_url=None, redoc_url=None)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    add_gate(app, keeper, lambda: service.snapshot.cell)
    add_live(app, service)
    site = Site(service, keeper)
    site.add("/", "Overview", rights.LOOK_AT_MEASURING, build_overview)
    site.add("/camera", "Camera", rights.LOOK_AT_CAMERA, build_camera)
    site.add("/measurement", "Measurement", rights.LOOK_AT_MEASURING, build_measurement)
    site.add("/production", "Production", rights.LOOK_AT_PRODUCTION, build_production)
    site.add("/log", "Log", rights.LOOK_AT_LOG, build_log)
    site.add("/settings", "Settings", rights.LOOK_AT_SETTINGS, build_settings)
    site.add("/users", "Users", rights.LOOK_AT_USERS, build_users)
    site.add("/help", "Help", rights.READ_HELP, build_help)
    add_export(app, site)
    add_log_export(app, site)
    app.mount("/api", make_api(site))
    run.process_pool_start_method = "spawn"
    core.sio.eio.cors_allowed_origins = []
    ui.run_with(
        app,
        title="Wearline",
        favicon=STATIC / "wearline.svg",
        reconnect_timeout=RECONNECT_S,
        show_welcome_message=False,
        tailwind=False,
        # Maps and pictures do not shrink, and packing them would hold up everybody; the network is a local one.
        gzip_middleware_factory=None,
    )
    # The last one added is asked first.
    app.add_middleware(Gate, keeper=keeper)
    app.add_middleware(Shield, allowed_hosts=frozenset(service.settings.allowed_hosts))
    return app


def serve(service: HmiService, folder: Path) -> WebServer:
    """Start the web server; users and sessions are kept in the folder.

    Raises:
        ConfigError: the address cannot be listened on, a file cannot be read, or the server did not start.
        RecordError: the users cannot be read.
    """
    settings = service.settings
    listener = _listen(settings.host, settings.port)
    try:
        forbidden = _forbidden(settings.forbidden_passwords)
        accounts = Accounts(folder / "accounts.db", 60.0 * settings.idle_minutes, 3600.0 * settings.session_hours)
    except WearlineError:
        listener.close()
        raise
    keeper = Doorkeeper(accounts, Hasher(), settings, forbidden)
    server = WebServer(make_app(service, keeper), listener, keeper)
    if not server.wait_started(START_S):
        server.close()
        raise ConfigError("the web server did not start", "hmi", "its log says why")
    LOG.info("web interface at %s", server.address)
    keeper.announce(server.address)
    return server
