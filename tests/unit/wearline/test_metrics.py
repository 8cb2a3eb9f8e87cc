"""The registry and its server."""

from __future__ import annotations

import json
import shutil
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

import pytest
from prometheus_client import generate_latest

from wearline import metrics
from wearline.errors import ConfigError


def get(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_series_is_declared_once() -> None:
    one = metrics.gauge("wearline_test_gauge", "A gauge", ("cell",))
    assert metrics.gauge("wearline_test_gauge", "A gauge", ("cell",)) is one
    with pytest.raises(ValueError, match="already a Gauge"):
        metrics.gauge("wearline_test_gauge", "A gauge", ("cell", "object"))
    with pytest.raises(ValueError, match="already a Gauge"):
        metrics.counter("wearline_test_gauge", "A gauge", ("cell",))


def test_it_serves_metrics_and_health() -> None:
    metrics.MESSAGES.labels("c9", "judge", "verdict", "out").inc(3)
    metrics.HANDLING.labels("c9", "judge", "verdict").observe(0.02)
    state: list[tuple[bool, Mapping[str, object]]] = [(True, {"status": "ready"})]
    server = metrics.serve("127.0.0.1", 0, lambda: state[0])
    try:
        status, text = get(server.port, "/metrics")
        assert status == 200
        series = 'wearline_messages_total{cell="c9",direction="out",service="judge",topic="verdict"} 3.0'
        assert series in text
        assert 'wearline_handling_seconds_bucket{cell="c9",le="0.025",service="judge",topic="verdict"} 1.0' in text
        assert "_created" not in text
        assert get(server.port, "/healthz?x") == (200, json.dumps({"status": "ready"}))
        state[0] = (False, {"status": "starting"})
        assert get(server.port, "/healthz") == (503, json.dumps({"status": "starting"}))
        assert get(server.port, "/livez")[0] == 200
        state[0] = (False, {"alive": False})
        assert get(server.port, "/livez") == (503, json.dumps({"alive": False}))
        assert get(server.port, "/secrets")[0] == 404
        with pytest.raises(ConfigError, match=f"127.0.0.1:{server.port}: cannot listen"):
            metrics.serve("127.0.0.1", server.port, lambda: state[0])
    finally:
        server.close()
    again = metrics.serve("127.0.0.1", server.port, lambda: state[0])
    again.close()


def test_room_on_disk_is_told(tmp_path: Path) -> None:
    metrics.watch_disk("c9", "judge", tmp_path)
    metrics.watch_disk("c9", "hmi", tmp_path / "absent")
    text = generate_latest(metrics.REGISTRY).decode()
    free, size = (
        float(
            next(line for line in text.splitlines() if line.startswith(name + '{cell="c9",service="judge"}')).split()[1]
        )
        for name in ("wearline_disk_free_bytes", "wearline_disk_size_bytes")
    )
    assert 0 < free < size == shutil.disk_usage(tmp_path).total
    assert 'wearline_disk_free_bytes{cell="c9",service="hmi"} NaN' in text
