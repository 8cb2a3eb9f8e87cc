"""Whether the service of this container is well: exit 0, or 1 with one line (the health check of every image).

A service is asked at /healthz on the port that cell.yaml gives it; router and simulated PLC, which have no such page,
are well while they listen. A service without a fixed port cannot be asked and counts as ill: a container needs one.
"""

from __future__ import annotations

import http.client
import os
import socket
import sys
from pathlib import Path
from typing import Any

import yaml

TIMEOUT_S = 2.0
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_PLC_PORT = 102


def ill(service: str, cell: dict[str, Any]) -> str:
    """Why the service is not well; empty when it is."""
    if service == "tools":
        return ""
    try:
        if service == "router":
            router = cell.get("router") or {}
            port = int(str(router.get("listen") or router.get("endpoint") or DEFAULT_ENDPOINT).rpartition(":")[2])
            socket.create_connection(("127.0.0.1", port), TIMEOUT_S).close()
            return ""
        if service == "plc-sim":
            port = int((cell.get("plc_sim") or {}).get("port") or DEFAULT_PLC_PORT)
            socket.create_connection(("127.0.0.1", port), TIMEOUT_S).close()
            return ""
        port = int((cell.get("metrics_ports") or {}).get(service) or 0)
        if not port:
            return f"metrics_ports.{service} is missing in cell.yaml; name a port, so that /healthz can be asked"
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        body = answer.read(2000).decode(errors="replace")
    except OSError as error:
        return f"does not answer ({error})"
    return "" if answer.status == 200 else f"{answer.status}: {body}"


def main() -> int:
    path = Path(os.environ.get("WEARLINE_CELL", "/etc/wearline/cell.yaml"))
    try:
        cell = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        cell, reason = {}, f"{path} cannot be read ({' '.join(str(error).split())})"
    else:
        reason = ill(os.environ.get("WEARLINE_SERVICE", ""), cell if isinstance(cell, dict) else {})
    if reason:
        sys.stdout.write(reason + "\n")
    return 1 if reason else 0


if __name__ == "__main__":
    sys.exit(main())
