"""Prometheus' rules and Grafana's dashboard: valid, tried on made-up series, and of series that exist."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.unit.deploy.test_containers import DEPLOY, ROOT, script

PROMETHEUS = DEPLOY / "prometheus"
BUCKETS = ("_bucket", "_sum", "_count")


def promtool(*words: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("promtool") is None:
        pytest.skip("promtool is not installed (Debian: apt install prometheus)")
    return subprocess.run(["promtool", *words], capture_output=True, text=True, timeout=60, check=False)


def rules() -> list[dict[str, Any]]:
    content = yaml.safe_load((PROMETHEUS / "rules.yml").read_text(encoding="utf-8"))
    return [rule for group in content["groups"] for rule in group["rules"]]


def expressions() -> dict[str, str]:
    """Every query of rules and dashboard, by where it stands."""
    dashboard = json.loads((DEPLOY / "grafana" / "wearline-cell.json").read_text(encoding="utf-8"))
    found = {rule.get("alert") or rule["record"]: rule["expr"] for rule in rules()}
    for panel in dashboard["panels"]:
        for target in panel.get("targets", ()):
            found[f"{panel['title']} {target['refId']}"] = target["expr"]
    return found


def documented() -> dict[str, tuple[str, ...]]:
    """Series -> labels, as docs/reference/metrics.md lists them."""
    text = (ROOT / "docs" / "reference" / "metrics.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(wearline_\w+)` \| (\w+) \| ([^|]*) \|", text, re.MULTILINE)
    return {name: tuple(re.findall(r"`(\w+)`", labels)) for name, _, labels in rows}


def test_prometheus_accepts_its_configuration() -> None:
    done = promtool("check", "config", str(PROMETHEUS / "prometheus.yml"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_rules_call_when_they_should_and_only_then() -> None:
    done = promtool("test", "rules", str(PROMETHEUS / "tests" / "rules_test.yml"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_each_alert_says_what_it_means_and_how_urgent_it_is() -> None:
    alerts = [rule for rule in rules() if "alert" in rule]
    assert len(alerts) >= 10
    for alert in alerts:
        assert alert["labels"]["severity"] in ("call", "look"), alert["alert"]
        assert set(alert["annotations"]) == {"summary", "description"}, alert["alert"]
        assert len(alert["annotations"]["description"]) > 40, alert["alert"]


def test_each_series_that_is_drawn_or_watched_is_offered() -> None:
    offered = set(documented())
    recorded = {rule["record"] for rule in rules() if "record" in rule}
    for place, expression in expressions().items():
        named = set(re.findall(r"(?:[a-z_]+:)?wearline_[a-z_]+(?::\w+)?", expression))
        assert named, place
        for name in named:
            plain = next((name.removesuffix(end) for end in BUCKETS if name.endswith(end)), name)
            assert name in recorded or plain in offered, f"{place}: nothing offers {name}"


def test_each_label_that_is_asked_for_is_offered() -> None:
    labels = {label for names in documented().values() for label in names} | {"le", "job"}
    for place, expression in expressions().items():
        asked = set(re.findall(r"(\w+)=~?\"", expression))
        for listed in re.findall(r"by \(([^)]*)\)", expression):
            asked |= set(re.split(r",\s*", listed))
        assert asked <= labels, f"{place}: {asked - labels}"


def test_what_runs_offers_what_is_documented() -> None:
    """Nothing is declared that no page explains."""
    declared: dict[str, tuple[str, ...]] = {}
    for path in [*(ROOT / "wearline").rglob("*.py"), *(ROOT / "services").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        for name, labels in re.findall(
            r"\b(?:counter|gauge|histogram)\(\s*\"(wearline_\w+)\",\s*\"[^\"]*\"(?:\s*\"[^\"]*\")*,\s*\(([^)]*)\)", text
        ):
            declared[name] = tuple(re.findall(r"\"(\w+)\"", labels))
    assert declared.items() <= documented().items()


def test_the_dashboard_is_what_its_program_draws() -> None:
    committed = json.loads((DEPLOY / "grafana" / "wearline-cell.json").read_text(encoding="utf-8"))
    drawn = script("grafana/build").dashboard()
    assert committed == drawn, "run: python deploy/grafana/build.py > deploy/grafana/wearline-cell.json"
    panels = [panel for panel in drawn["panels"] if panel["type"] != "row"]
    assert len({panel["id"] for panel in drawn["panels"]}) == len(drawn["panels"])
    for one in panels:
        for other in panels:
            assert one is other or not overlap(one["gridPos"], other["gridPos"]), (one["title"], other["title"])


def overlap(one: dict[str, int], other: dict[str, int]) -> bool:
    return (
        one["x"] < other["x"] + other["w"]
        and other["x"] < one["x"] + one["w"]
        and one["y"] < other["y"] + other["h"]
        and other["y"] < one["y"] + one["h"]
    )


def test_cells_are_added_by_files() -> None:
    config = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text(encoding="utf-8"))
    (job,) = config["scrape_configs"]
    assert job["honor_labels"] is True
    assert job["file_sd_configs"][0]["files"] == ["cells/*.yml"]
    assert Path(PROMETHEUS / "cells" / "compose.yml").exists()
