"""Who may call the web server."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from wearline_hmi.pages.shield import HEADERS, Shield, host_name, is_known_host, is_own_origin


@pytest.mark.parametrize(
    ("netloc", "name"),
    [("Press7:8080", "press7"), ("[::1]:80", "::1"), ("127.0.0.1", "127.0.0.1"), ("", "")],
)
def test_host_names(netloc: str, name: str) -> None:
    assert host_name(netloc) == name


@pytest.mark.parametrize(
    ("netloc", "is_known"),
    [("127.0.0.1:80", True), ("10.1.2.3", True), ("[fe80::1]:80", True), ("localhost:1", True), ("press7:80", True),
     ("evil.example", False), ("", False), ("press7.evil.example", False)],
)  # fmt: skip
def test_only_addresses_and_configured_names_are_known(netloc: str, is_known: bool) -> None:
    assert is_known_host(netloc, frozenset({"press7"})) == is_known


@pytest.mark.parametrize(
    ("origin", "is_own"),
    [("http://press7:80", True), ("https://press7:80", True), ("http://evil.example", False), ("null", False),
     ("http://press7", False), ("http://press7:80.evil.example", False)],
)  # fmt: skip
def test_only_the_own_origin_is_own(origin: str, is_own: bool) -> None:
    assert is_own_origin(origin, "press7:80") == is_own


def call(kind: str, method: str = "GET", **headers: str) -> list[Any]:
    """What the server sends back."""
    sent: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if kind == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b"ok"})
        else:
            await send({"type": "websocket.accept"})

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": "http.request"}

    scope = {
        "type": kind, "method": method, "path": "/", "headers": [(k.encode(), v.encode()) for k, v in headers.items()],
    }  # fmt: skip
    asyncio.run(Shield(app, frozenset())(scope, receive, send))
    return sent


def status(sent: list[Any]) -> Any:
    return sent[0].get("status", sent[0]["type"])


@pytest.mark.parametrize(
    ("kind", "method", "headers", "wanted"),
    [
        ("http", "GET", {"host": "127.0.0.1:1"}, 200),
        ("http", "GET", {"host": "evil.example"}, 403),
        ("http", "GET", {"host": "127.0.0.1:1", "origin": "http://evil.example"}, 403),
        ("http", "POST", {"host": "127.0.0.1:1"}, 403),
        ("http", "POST", {"host": "127.0.0.1:1", "origin": "http://127.0.0.1:1"}, 200),
        ("websocket", "GET", {"host": "127.0.0.1:1", "origin": "http://127.0.0.1:1"}, "websocket.accept"),
        ("websocket", "GET", {"host": "127.0.0.1:1", "origin": "http://evil.example"}, "websocket.close"),
        ("websocket", "GET", {"host": "127.0.0.1:1"}, "websocket.close"),
    ],
)  # fmt: skip
def test_strangers_are_refused(kind: str, method: str, headers: dict[str, str], wanted: object) -> None:
    assert status(call(kind, method, **headers)) == wanted


def test_every_answer_bears_the_security_headers() -> None:
    sent = call("http", host="127.0.0.1:1")
    names = {name.decode() for name, _ in sent[0]["headers"]}
    assert {name.lower() for name in HEADERS} <= names
