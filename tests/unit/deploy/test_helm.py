"""The Helm chart: what can be said of it without helm, and (slow) what helm makes of it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.unit.deploy.test_containers import DEPLOY, VERSION
from wearline.config import load_cell
from wearline.topics import SERVICES

CHART = DEPLOY / "helm" / "wearline-cell"
TEMPLATES = {path.stem: path.read_text(encoding="utf-8") for path in (CHART / "templates").glob("*.yaml")}
VALUES: dict[str, Any] = yaml.safe_load((CHART / "values.yaml").read_text(encoding="utf-8"))
SCHEMA: dict[str, Any] = json.loads((CHART / "values.schema.json").read_text(encoding="utf-8"))
WORKLOADS = (*SERVICES, "router", "plc-sim")


def test_the_chart_has_the_version_of_the_code() -> None:
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text(encoding="utf-8"))
    assert chart["version"] == chart["appVersion"] == VERSION


def test_the_rules_are_those_of_deploy_prometheus() -> None:
    source = DEPLOY / "prometheus" / "rules.yml"
    assert (CHART / "rules.yml").read_bytes() == source.read_bytes(), f"copy {source} into the chart"


@pytest.mark.parametrize("name", WORKLOADS)
def test_each_workload_takes_the_common_restrictions(name: str) -> None:
    text = TEMPLATES[name]
    assert text.count('include "wearline.pod"') == 1
    containers = len(re.findall(r"^ +- name: (?:setup|" + name + r")$", text, re.MULTILINE))
    assert text.count('include "wearline.container"') == containers >= 1
    assert "resources:" in text
    assert 'include "wearline.probes"' in text or text.count("Probe:") == 3
    assert 'include "wearline.checksum"' in text
    assert "privileged" not in text and "hostPath" not in text


def test_no_two_of_what_there_must_be_one_of() -> None:
    for name in ("capture", "judge", "hmi", "plc-sim"):
        assert "strategy: {type: Recreate}" in TEMPLATES[name], name
        assert "  replicas: 1\n" in TEMPLATES[name], name
    assert "kind: StatefulSet" in TEMPLATES["fieldbus"]
    assert "  replicas: 1\n" in TEMPLATES["fieldbus"]
    assert "replicas: {{ .Values.reconstruct.replicas }}" in TEMPLATES["reconstruct"]


def test_nobody_is_killed_for_a_router_that_is_gone() -> None:
    helpers = (CHART / "templates" / "_helpers.tpl").read_text(encoding="utf-8")
    liveness = helpers[helpers.index("livenessProbe:") :]
    assert "path: /livez" in liveness
    readiness = helpers[helpers.index("readinessProbe:") : helpers.index("livenessProbe:")]
    assert "path: /healthz" in readiness


def test_the_ports_are_those_of_the_example() -> None:
    helpers = (CHART / "templates" / "_helpers.tpl").read_text(encoding="utf-8")
    listed = re.search(r"get \(dict ([^)]*)\)", helpers)
    assert listed is not None
    words = re.findall(r'"([^"]+)"', listed[1])
    example = load_cell(DEPLOY / "cells" / "compose.yaml").metrics_ports
    assert dict(zip(words[::2], map(int, words[1::2]), strict=True)) == example


def test_each_value_is_in_the_schema_and_each_entry_of_the_schema_has_a_value() -> None:
    def walk(values: object, schema: dict[str, Any], place: str) -> None:
        known = schema.get("properties")
        if known is None or not isinstance(values, dict):
            return
        assert schema.get("additionalProperties") is False, f"{place} takes anything"
        assert values.keys() == known.keys() - {"global"}, place
        for name, value in values.items():
            reference = str(known[name].get("$ref", "")).rpartition("/")[2]
            walk(value, SCHEMA["definitions"][reference] if reference else known[name], f"{place}.{name}")

    walk(VALUES, SCHEMA, "values")


# --- with helm ---


def rendered(*settings: str) -> list[dict[str, Any]]:
    if shutil.which("helm") is None:
        pytest.skip("helm is not installed (https://helm.sh)")
    done = subprocess.run(
        ["helm", "template", "press", str(CHART), "--kube-version", "1.30.0", "--set", "cell=c1", *settings],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [document for document in yaml.safe_load_all(done.stdout) if document]


def pods(documents: list[dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    for document in documents:
        if document["kind"] in ("Deployment", "StatefulSet"):
            yield document["metadata"]["name"], document["spec"]["template"]["spec"]


REAL: tuple[str, ...] = ()
SIMULATED = ("--set", "simulated.enabled=true", "--set", "certificates.enabled=false")
VARIANTS = pytest.mark.parametrize("settings", [REAL, SIMULATED], ids=["real", "simulated"])


@pytest.mark.slow
@VARIANTS
def test_helm_finds_no_fault(settings: tuple[str, ...]) -> None:
    rendered(*settings)
    done = subprocess.run(
        ["helm", "lint", str(CHART), "--strict", "--set", "cell=c1", *settings],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@VARIANTS
def test_what_helm_makes_has_no_more_rights_than_it_needs(settings: tuple[str, ...]) -> None:
    found = dict(pods(rendered(*settings)))
    assert {name.removeprefix("press-") for name in found} == {
        *SERVICES, "router", *(["plc-sim"] if settings else [])
    }  # fmt: skip
    for name, pod in found.items():
        assert pod["automountServiceAccountToken"] is False, name
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        assert pod["securityContext"]["runAsUser"] == 10001, name
        assert pod["securityContext"]["seccompProfile"]["type"] == "RuntimeDefault", name
        assert "hostNetwork" not in pod, name
        for container in [*pod["containers"], *pod.get("initContainers", ())]:
            rights = container["securityContext"]
            assert rights["readOnlyRootFilesystem"] is True, name
            assert rights["allowPrivilegeEscalation"] is False, name
            assert rights["capabilities"] == {"drop": ["ALL"]}, name
            assert container["resources"]["limits"]["memory"] == container["resources"]["requests"]["memory"], name
            assert container["image"].endswith(f":{VERSION}"), name
        for container in pod["containers"]:
            assert {"startupProbe", "readinessProbe", "livenessProbe"} <= container.keys(), name


@pytest.mark.slow
@VARIANTS
def test_what_helm_makes_of_the_settings_can_be_obeyed(settings: tuple[str, ...], tmp_path: Path) -> None:
    from wearline.cli import main

    documents = rendered(*settings)
    (config,) = (d for d in documents if d["kind"] == "ConfigMap")
    path = tmp_path / "cell.yaml"
    path.write_text(config["data"]["cell.yaml"], encoding="utf-8")
    cell = load_cell(path)
    assert cell.cell == "c1"
    assert cell.router.endpoint.endswith("/press-router:7447")
    assert (cell.router.tls is None) is bool(settings)
    for service in SERVICES:
        with pytest.raises(SystemExit) as ended:
            main(["run", service, "--config", str(path), "--check-config"])
        assert ended.value.code == 0, service


@pytest.mark.slow
def test_helm_refuses_what_cannot_be() -> None:
    rendered()
    for wrong in ("cell=Press 1", "image.tag=latest", "nosuch.value=1", "fieldbus.plcNetwork=everybody"):
        done = subprocess.run(
            ["helm", "template", "press", str(CHART), "--kube-version", "1.30.0", "--set", "cell=c1", "--set", wrong],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode != 0, wrong
