"""The HTTP API as a program sees it; no browser is needed."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.browser.conftest import Hmi
from tests.browser.feed import Feed
from tests.contract.conftest import until
from wearline import messages as m
from wearline_hmi.drivers.accounts import Accounts
from wearline_hmi.pages.gate import COOKIE


@pytest.fixture
def token(accounts: Accounts) -> Iterator[str]:
    yield accounts.add_token("test", "ada")
    accounts.remove_token("test")


def call(url: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
    request = urllib.request.Request(url, method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def get(hmi: Hmi, token: str, path: str) -> Any:
    status, body = call(f"{hmi.url}/api/v1/{path}", Authorization=f"Bearer {token}")
    assert status == 200, body
    return json.loads(body)


def test_nobody_reads_without_a_token_or_a_login(hmi: Hmi, accounts: Accounts, token: str) -> None:
    for path in ("cell", "records", "records/x", "trends", "maps", "maps/x"):
        assert call(f"{hmi.url}/api/v1/{path}")[0] == 401
    assert call(f"{hmi.url}/api/v1/cell")[0] == 401, "a viewer does not read through the API"
    assert call(f"{hmi.url}/api/v1/cell", Authorization="Bearer wl_wrong")[0] == 401
    user = accounts.user("olga")
    assert user is not None
    session = accounts.open_session(user, "127.0.0.1")
    assert call(f"{hmi.url}/api/v1/cell", Cookie=f"{COOKIE}={session}")[0] == 200
    accounts.remove_token("test")
    assert call(f"{hmi.url}/api/v1/cell", Authorization=f"Bearer {token}")[0] == 401


def test_a_token_reads_and_changes_nothing(hmi: Hmi, token: str) -> None:
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        status, _ = call(f"{hmi.url}/api/v1/records", method, Authorization=f"Bearer {token}")
        assert status == 405
    assert call(f"{hmi.url}/users", Authorization=f"Bearer {token}")[0] == 403, "it opens no page"


def test_states_records_trends_and_maps_are_read(hmi: Hmi, feed: Feed, token: str) -> None:
    cycle_id = feed.stroke(61, m.Decision.FAILED)
    until(lambda: get(hmi, token, "cell")["last_cycle_id"] == cycle_id)
    cell = get(hmi, token, "cell")
    assert (cell["cell"], cell["last_decision"]) == ("press-7", "FAILED")
    assert 0 <= cell["last_verdict_age_s"] < 10
    assert cell["services"]["judge"]["state"]["status"] == "ready"
    rows = get(hmi, token, "records?last=3&decision=FAILED")
    assert rows[0]["cycle_id"] == cycle_id
    assert {row["decision"] for row in rows} == {"FAILED"}
    older = get(hmi, token, f"records?last=3&before={rows[0]['record_id']}")
    assert all(row["record_id"] < rows[0]["record_id"] for row in older)
    assert m.Verdict.model_validate(get(hmi, token, f"records/{cycle_id}")).request.stroke == 61
    (trend,) = get(hmi, token, "trends")
    assert trend["limit_mm"] == 0.1
    until(lambda: get(hmi, token, "maps")["cycle_id"] == cycle_id)
    header = get(hmi, token, "maps")
    status, body = call(hmi.url + header["url"], Authorization=f"Bearer {token}")
    assert status == 200
    maps = np.frombuffer(body, "<f4").reshape(len(header["names"]), header["rows"], header["cols"])
    assert np.isnan(maps[header["names"].index("difference")]).any(), "what was not measured is NaN"


def test_what_is_not_there_or_out_of_range_is_said(hmi: Hmi, token: str) -> None:
    bearer = f"Bearer {token}"
    assert call(f"{hmi.url}/api/v1/records/no-such-cycle", Authorization=bearer)[0] == 404
    assert call(f"{hmi.url}/api/v1/maps/no-such-cycle", Authorization=bearer)[0] == 404
    assert call(f"{hmi.url}/api/v1/records?last=100000", Authorization=bearer)[0] == 422
    assert call(f"{hmi.url}/api/v1/records?decision=MAYBE", Authorization=bearer)[0] == 422


def test_it_is_described_as_openapi(hmi: Hmi, token: str) -> None:
    status, body = call(f"{hmi.url}/api/openapi.json")
    assert status == 200
    paths = json.loads(body)["paths"]
    assert set(paths) == {
        "/v1/cell", "/v1/records", "/v1/records/{cycle_id}", "/v1/trends", "/v1/maps", "/v1/maps/{cycle_id}",
    }  # fmt: skip
    assert {method for path in paths.values() for method in path} == {"get"}
