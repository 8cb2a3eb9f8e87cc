"""Dockerfile, compose.yaml and health check, without an engine."""

from __future__ import annotations

import importlib.util
import re
import socket
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from wearline import metrics
from wearline.topics import SERVICES

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "deploy"
DOCKERFILE = (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
CONTAINERS: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = (*SERVICES, "router", "plc-sim")
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


def script(name: str) -> ModuleType:
    """A program of deploy/ as a module."""
    spec = importlib.util.spec_from_file_location(name.replace("/", "_"), DEPLOY / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their own module up.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def stages() -> dict[str, list[str]]:
    """Instructions of each stage of the Dockerfile, continuation lines joined, comments left out."""
    joined = re.sub(r"^\s*#.*\n", "", DOCKERFILE, flags=re.MULTILINE).replace("\\\n", " ")
    found: dict[str, list[str]] = {}
    name = ""
    for line in filter(None, (line.strip() for line in joined.splitlines())):
        if match := re.fullmatch(r"FROM (\S+) AS (\S+)", line):
            name = match[2]
            found[name] = []
        if name:
            found[name].append(line)
    return found


# --- Dockerfile ---


def test_every_stage_starts_from_the_one_base_or_from_another_stage() -> None:
    origins = {name: lines[0].split()[1] for name, lines in stages().items()}
    assert origins == {
        "base": "${BASE}", "build": "base", "package": "${BASE}", "prometheus": "${BASE}", "service": "base"
    }  # fmt: skip
    assert re.search(r"^ARG BASE=debian:bookworm-slim$", DOCKERFILE, re.MULTILINE)
    assert "latest" not in DOCKERFILE


@pytest.mark.parametrize("stage", ["service", "prometheus"])
def test_what_runs_is_no_root_and_says_how_it_is(stage: str) -> None:
    lines = stages()[stage]
    assert [line for line in lines if line.startswith("USER ")] == ["USER 10001:10001"]
    assert lines.index("USER 10001:10001") > max(
        i for i, line in enumerate(lines) if line.startswith(("RUN", "COPY")) or i == 0
    )
    assert sum(line.startswith("HEALTHCHECK ") for line in lines) == 1
    assert all(line.split(maxsplit=1)[1].startswith("[") for line in lines if line.startswith("ENTRYPOINT"))


def test_no_secret_and_no_download_outlives_the_build() -> None:
    for lines in stages().values():
        for line in lines:
            assert not line.startswith("ADD "), line
            assert not re.search(r"(?i)^(env|arg) .*(password|secret|token|key)", line), line
    assert "--mount=type=secret,id=ca" in DOCKERFILE
    copied = [line for line in stages()["service"] if line.startswith("COPY")]
    assert copied == ["COPY --from=build /opt/wearline /opt/wearline"]


def test_what_is_installed_into_a_stage_that_runs_leaves_no_lists_behind() -> None:
    (line,) = (line for line in stages()["base"] if "apt-get install" in line)
    assert line.index("rm -rf /var/lib/apt/lists/* /var/cache/apt/*") > line.index("apt-get install")
    assert not any("apt-get" in line for stage in ("service", "prometheus") for line in stages()[stage])


def test_third_party_packages_come_by_hash_alone() -> None:
    installer = (DEPLOY / "install.sh").read_text(encoding="utf-8").replace("\\\n", " ")
    installs = re.findall(r"^ *pip [^#\n]*\binstall\b[^\n]*", installer, re.MULTILINE)
    assert len(installs) == 4
    for line in installs:
        assert "--dry-run" in line or "--require-hashes" in line or "--no-index" in line, line
        assert "--dry-run" in line or "--no-deps" in line, line


def test_each_image_is_known_to_the_scripts() -> None:
    installer = (DEPLOY / "install.sh").read_text(encoding="utf-8")
    builder = (DEPLOY / "images.sh").read_text(encoding="utf-8")
    listed = re.search(r"\[ \$# -gt 0 \] \|\| set -- (.*)", builder)
    assert listed is not None
    assert set(listed[1].split()) == {*OURS, "tools", "prometheus"}
    alternatives = " | ".join(sorted(SERVICES))
    assert f"    {alternatives}) parts=$service" in installer
    for other in ("router", "plc-sim", "tools"):
        assert re.search(rf"^ +{other}\) parts=", installer, re.MULTILINE), other


def test_an_image_gets_the_pinned_blocks_of_what_it_wants() -> None:
    dependencies = script("dependencies")
    blocks = dependencies.locked({"numpy", "prometheus-client"})
    assert [block.split("==")[0] for block in blocks] == ["numpy", "prometheus-client"]
    assert all("--hash=sha256:" in block for block in blocks)
    with pytest.raises(SystemExit, match=r"does not pin nothing-of-the-kind"):
        dependencies.locked({"numpy", "nothing-of-the-kind"})
    assert dependencies.plain("psycopg[binary]>=3") == "psycopg"
    assert dependencies.plain("Zope.Interface ==1") == "zope-interface"


# --- compose.yaml ---


def test_the_whole_cell_is_there() -> None:
    assert set(CONTAINERS) == {*OURS, "setup", "prometheus"}


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_container_has_no_more_rights_than_it_needs(name: str) -> None:
    container = CONTAINERS[name]
    assert container["user"] == "10001:10001"
    assert container["read_only"] is True
    assert container["cap_drop"] == ["ALL"]
    assert "cap_add" not in container and "privileged" not in container
    assert container["security_opt"] == ["no-new-privileges:true"]
    assert container["pids_limit"] <= 256
    assert re.fullmatch(r"\d+[mg]", container["mem_limit"])
    assert any(entry.startswith("/tmp:size=") for entry in container["tmpfs"])
    assert container["logging"]["options"]["max-size"]
    assert "environment" not in container, "settings belong in cell.yaml and secrets in files"
    for volume in container["volumes"]:
        source, target, *mode = volume.replace("${WEARLINE_CELL:-./cells/compose.yaml}", "./cell.yaml").split(":")
        assert "docker.sock" not in volume
        if source.startswith("."):
            assert mode == ["ro"], volume
        else:
            assert source in COMPOSE["volumes"], volume
            assert target.startswith("/var/lib/"), volume


@pytest.mark.parametrize("name", CONTAINERS)
def test_images_are_those_of_this_version(name: str) -> None:
    image = {"setup": "tools"}.get(name, name)
    assert CONTAINERS[name]["image"] == f"${{WEARLINE_REGISTRY:-wearline}}/{image}:${{WEARLINE_VERSION:-{VERSION}}}"


def test_only_people_are_let_in_and_only_from_this_machine() -> None:
    published = {name: c["ports"] for name, c in CONTAINERS.items() if "ports" in c}
    assert published == {
        "hmi": ["${WEARLINE_HMI:-127.0.0.1:8080}:8080"],
        "prometheus": ["${WEARLINE_PROMETHEUS:-127.0.0.1:9090}:9090"],
    }
    networks: Mapping[str, Any] = COMPOSE["networks"]
    assert [name for name, network in networks.items() if not network.get("internal")] == ["plant"]
    joined = {name: set(c.get("networks", ())) for name, c in CONTAINERS.items()}
    assert joined["router"] == {"cell"}
    assert joined["plc-sim"] == {"plc"}
    assert {name for name in joined if "plc" in joined[name]} == {"fieldbus", "plc-sim"}
    assert "cell" not in joined["prometheus"]
    assert {name for name in joined if "plant" in joined[name]} == {"hmi", "prometheus"}
    assert CONTAINERS["setup"]["network_mode"] == "none"


def test_each_service_keeps_its_data_in_a_volume_of_its_own() -> None:
    for name in SERVICES:
        assert f"{name}:/var/lib/wearline/{name}" in CONTAINERS[name]["volumes"]
    assert "judge:/var/lib/wearline/judge" in CONTAINERS["setup"]["volumes"]


def test_prometheus_looks_where_the_services_tell() -> None:
    cell = yaml.safe_load((DEPLOY / "cells" / "compose.yaml").read_text(encoding="utf-8"))
    targets = yaml.safe_load((DEPLOY / "prometheus" / "cells" / "compose.yml").read_text(encoding="utf-8"))
    assert {entry["labels"]["service"]: entry["targets"] for entry in targets} == {
        name: [f"{name}:{port}"] for name, port in cell["metrics_ports"].items()
    }
    assert {entry["labels"]["cell"] for entry in targets} == {cell["cell"]}
    assert set(cell["metrics_ports"]) == set(SERVICES)
    for name in SERVICES:
        assert "watch" in CONTAINERS[name]["networks"], name


# --- the health check ---


def test_the_health_check_believes_healthz() -> None:
    ill = script("healthcheck").ill
    state: list[tuple[bool, Mapping[str, object]]] = [(True, {"status": "ready"})]
    server = metrics.serve("127.0.0.1", 0, lambda: state[0])
    cell = {"metrics_ports": {"judge": server.port}}
    try:
        assert ill("judge", cell) == ""
        state[0] = (False, {"status": "starting"})
        assert ill("judge", cell) == '503: {"status": "starting"}'
        assert "metrics_ports.capture is missing in cell.yaml" in ill("capture", cell)
    finally:
        server.close()
    assert "does not answer" in ill("judge", cell)


@pytest.mark.parametrize("service", ["router", "plc-sim"])
def test_the_health_check_of_those_without_a_page_tries_their_port(service: str) -> None:
    ill = script("healthcheck").ill
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        cell = {"router": {"endpoint": "tcp/router:1", "listen": f"tcp/0.0.0.0:{port}"}, "plc_sim": {"port": port}}
        assert ill(service, cell) == ""
    assert "does not answer" in ill(service, cell)


def test_the_health_check_names_a_cell_that_cannot_be_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WEARLINE_CELL", str(tmp_path / "cell.yaml"))
    monkeypatch.setenv("WEARLINE_SERVICE", "judge")
    assert script("healthcheck").main() == 1
    assert "cell.yaml cannot be read" in capsys.readouterr().out
