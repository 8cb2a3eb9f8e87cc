"""What every request passes first: who is named, who sent it, and what the browser may do with the answer."""

from __future__ import annotations

import ipaddress
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


def host_name(netloc: str) -> str:
    """The name in a Host header, without port and brackets, in lower case."""
    if netloc.startswith("["):
        return netloc[1:].partition("]")[0].lower()
    return netloc.partition(":")[0].lower()


def is_known_host(netloc: str, allowed: frozenset[str]) -> bool:
    """Whether a browser may call this server by that name.

    Addresses are always right; a name that was not configured may be another site's that points here (DNS rebinding).
    """
    name = host_name(netloc)
    if name == "localhost" or name in allowed:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(origin: str, netloc: str) -> bool:
    """Whether a request was sent by a page of this very server."""
    return origin.partition("://")[2].lower() == netloc.lower()


class Shield:
    """Refuses unknown hosts and foreign origins, and adds the security headers."""

    def __init__(self, app: ASGIApp, allowed_hosts: frozenset[str]) -> None:
        self._app, self._allowed = app, frozenset(name.lower() for name in allowed_hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if (refusal := self._refusal(scope)) is not None:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                await PlainTextResponse(refusal + "\n", 403)(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> str | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not is_known_host(host, self._allowed):
            return f"this server is not {host_name(host)}; add the name to hmi.allowed_hosts in cell.yaml"
        origin = headers.get("origin")
        # A browser always names the origin of a socket and of what it posts.
        if origin is None:
            is_safe = scope["type"] == "http" and scope["method"] in ("GET", "HEAD", "OPTIONS")
            return None if is_safe or "authorization" in headers else "the request does not say where it comes from"
        return None if is_own_origin(origin, host) else "the request comes from another site"
