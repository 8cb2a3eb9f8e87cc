"""`make e2e`: deploy/compose.yaml for real, in whatever Docker engine answers."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import subprocess
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.contract.conftest import free_port
from wearline.topics import SERVICES

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = ROOT / "deploy" / "compose.yaml"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def docker(*words: str, check: bool = True) -> str:
    done = subprocess.run(
        [os.environ.get("DOCKER", "docker"), *words], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 or not check, f"docker {' '.join(words)}: {done.stderr}"
    return done.stdout.strip()


class Running:
    """The composed cell."""

    def __init__(self) -> None:
        self.project = f"wearline-e2e-{secrets.token_hex(3)}"
        self.hmi, self.prometheus = free_port(), free_port()
        self._containers: dict[str, str] = {}
        self._environment = {
            **os.environ,
            "WEARLINE_HMI": f"127.0.0.1:{self.hmi}",
            "WEARLINE_PROMETHEUS": f"127.0.0.1:{self.prometheus}",
        }

    def compose(self, *words: str, check: bool = True) -> str:
        program = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
        done = subprocess.run(
            [*program, "-p", self.project, "-f", str(COMPOSE), *words],
            capture_output=True, text=True, timeout=300, check=False, env=self._environment,
        )  # fmt: skip
        assert done.returncode == 0 or not check, f"compose {' '.join(words)}: {done.stderr[-2000:]}"
        return done.stdout

    def container(self, service: str) -> str:
        """The container's id, which outlives a restart."""
        if service not in self._containers:
            self._containers[service] = self.compose("ps", "-q", service).strip()
        return self._containers[service]

    def inspected(self, service: str) -> dict[str, Any]:
        (found,) = json.loads(docker("inspect", self.container(service)))
        return dict(found)

    def total(self, query: str) -> float:
        """A PromQL query that gives one number; 0 while it gives none."""
        address = f"http://127.0.0.1:{self.prometheus}/api/v1/query?query={urllib.parse.quote(query)}"
        try:
            with urllib.request.urlopen(address, timeout=5) as answer:
                result = json.load(answer)["data"]["result"]
        except (OSError, urllib.error.URLError):
            return 0.0
        return float(result[0]["value"][1]) if result else 0.0

    def measured(self) -> float:
        return self.total('sum(wearline_cycles_total{cell="compose",decision=~"PASSED|FAILED"})')


def until(condition: Callable[[], bool], within_s: float, what: str, running: Running) -> None:
    pause, end_s = threading.Event(), time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, f"not within {within_s:g} s: {what}\n{running.compose('logs', '--tail=8')}"
        pause.wait(1.0)


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    if shutil.which("docker") is None or not docker("info", "--format", "{{.ServerVersion}}", check=False):
        pytest.skip("no Docker engine answers")
    if not (shutil.which("docker-compose") or docker("compose", "version", check=False)):
        pytest.skip("there is neither docker-compose nor docker compose")
    version = yaml.safe_load(COMPOSE.read_text())["services"]["judge"]["image"].rpartition(":-")[2].rstrip("}")
    if not docker("images", "-q", f"{os.environ.get('WEARLINE_REGISTRY', 'wearline')}/judge:{version}"):
        pytest.skip("the images are not there: make images")
    cell = Running()
    try:
        cell.compose("up", "-d")
        yield cell
    finally:
        cell.compose("down", "-v", "-t", "5", check=False)


def test_the_cell_measures(running: Running, capsys: pytest.CaptureFixture[str]) -> None:
    started_s = time.monotonic()
    until(lambda: running.measured() >= 8, 180.0, "eight parts are measured", running)
    first_s = time.monotonic() - started_s
    assert running.total('sum(wearline_cycles_total{cell="compose",decision="PASSED"})') >= 1
    until(lambda: running.total('sum(up{job="wearline"})') == len(SERVICES), 30.0, "all metrics are read", running)
    with capsys.disabled():
        print(f"\ncompose: eight parts were measured {first_s:.0f} s after the containers had started")


def test_containers_are_well_and_have_no_rights(running: Running) -> None:
    for service in (*SERVICES, "router", "plc-sim", "prometheus"):
        until(lambda: health(running, service) == "healthy", 90.0, f"{service} is healthy", running)  # noqa: B023
        found = running.inspected(service)
        assert found["Config"]["User"] == "10001:10001", service
        assert found["HostConfig"]["ReadonlyRootfs"] is True, service
        assert found["HostConfig"]["CapDrop"] == ["ALL"], service
        status = docker("exec", running.container(service), "cat", "/proc/1/status")
        facts: Mapping[str, str] = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        assert facts["CapEff"].strip() == "0" * 16, service
        assert facts["NoNewPrivs"].strip() == "1", service
        assert facts["Uid"].split() == ["10001"] * 4, service
        assert docker("exec", running.container(service), "sh", "-c", "echo > /proof || echo refused") == "refused"


def health(running: Running, service: str) -> str:
    return str(running.inspected(service)["State"].get("Health", {}).get("Status"))


def test_people_see_it_and_nobody_else_gets_in(running: Running) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{running.hmi}/", timeout=10) as answer:
        assert answer.status == 200
    for service in SERVICES:
        ports = running.inspected(service)["NetworkSettings"]["Ports"] or {}
        published = [b["HostIp"] for bindings in ports.values() if bindings for b in bindings]
        assert published == (["127.0.0.1"] if service == "hmi" else []), service
    # Prometheus reaches the metrics and not the bus.
    script = "import socket; socket.create_connection(('router', 7447), 2)"
    assert docker("exec", running.container("judge"), "python", "-c", f"{script}; print('in')", check=False) == "in"
    names = running.inspected("prometheus")["NetworkSettings"]["Networks"]
    assert not any(name.endswith("_cell") for name in names)


@pytest.mark.parametrize("service", ["router", "reconstruct", "judge", "fieldbus"])
def test_it_measures_again_after_a_restart(running: Running, service: str) -> None:
    docker("restart", "-t", "1", running.container(service))
    before = running.measured()
    # Counters of a restarted fieldbus begin at zero.
    until(
        lambda: running.measured() > (before if service != "fieldbus" else 0) + 2, 90.0, "parts are measured", running
    )


def test_no_image_holds_a_secret(running: Running) -> None:
    for service in (*SERVICES, "router", "plc-sim", "prometheus"):
        image = running.inspected(service)["Config"]["Image"]
        history = docker("history", "--no-trunc", "--format", "{{.CreatedBy}}", image).lower()
        environment = " ".join(running.inspected(service)["Config"]["Env"]).lower()
        for word in ("password", "token", "begin certificate", "begin private", "secret_"):
            assert word not in history, f"{image}: {word}"
            assert word not in environment, f"{image}: {word}"
        inside = docker("exec", running.container(service), "sh", "-c", "ls /run/secrets 2>/dev/null; true")
        assert inside == "", image
