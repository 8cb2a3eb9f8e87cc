"""Print the Grafana dashboard of one cell (schema 38, Grafana 10 and later).

``python deploy/grafana/build.py > deploy/grafana/wearline-cell.json``. It draws what wearline/metrics.py and the
services offer and the recording rules of deploy/prometheus/rules.yml; tests check that each series it names exists.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from typing import Any

SOURCE = {"type": "prometheus", "uid": "${source}"}
CELL = '{cell="$cell"}'
GREEN, YELLOW, RED = "green", "yellow", "red"


@dataclass(frozen=True)
class Panel:
    """One picture: its queries are (expression, legend)."""

    title: str
    queries: tuple[tuple[str, str], ...]
    unit: str
    width: int
    kind: str = "timeseries"
    about: str = ""
    steps: tuple[tuple[float | None, str], ...] = ((None, GREEN),)
    words: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Value -> (what is shown instead, colour)."""


def sums(name: str, by: str, window: str = "5m", where: str = "") -> str:
    """A rate, summed over all but some labels."""
    return f'sum by ({by}) (rate({name}{{cell="$cell"{where}}}[{window}]))'


UP = {"0": ("down", RED), "1": ("up", GREEN)}
ROWS: tuple[tuple[str, int, tuple[Panel, ...]], ...] = (
    (
        "The cell now", 5,
        (
            Panel(
                "Services", ((f"min by (service) (wearline_service_up{CELL})", "{{service}}"),), "none", 10, "stat",
                words=UP,
            ),
            Panel("PLC link", ((f"wearline_plc_link_up{CELL}", "PLC"),), "none", 3, "stat", words=UP),
            Panel(
                "Parts per minute", ((f"60 * cell:wearline_cycles:rate5m{CELL}", ""),), "none", 3, "stat",
            ),
            Panel(
                "Not measured", ((f"cell:wearline_not_measured:ratio10m{CELL}", ""),), "percentunit", 4, "stat",
                "Of the last ten minutes; each was told Failed.", ((None, GREEN), (0.005, YELLOW), (0.02, RED)),
            ),
            Panel(
                "Slowest of a hundred cycles", ((f"cell:wearline_cycle_seconds:p99_10m{CELL}", ""),), "s", 4, "stat",
                "Measure to Measure finished. At 2.5 s a part is told NOT_MEASURED.",
                ((None, GREEN), (1.5, YELLOW), (2.0, RED)),
            ),
        ),
    ),
    (
        "Parts", 8,
        (
            Panel("Decisions", ((sums("wearline_cycles_total", "decision"), "{{decision}}"),), "ops", 12),
            Panel(
                "Mean error", ((f"wearline_mean_error_millimeters{CELL}", "object {{object}}"),), "lengthmm", 12,
                about="Of the last part: mean absolute deviation over the area that deviates.",
            ),
        ),
    ),
    (
        "The die", 8,
        (
            Panel(
                "Wear", ((f"wearline_wear_millimeters{CELL}", "object {{object}}, zone {{zone}}"),), "lengthmm", 8,
                about="95th percentile of the deviation in the largest significant region.",
            ),
            Panel(
                "Wear per thousand strokes",
                ((f"wearline_wear_slope_millimeters_per_kilostroke{CELL}", "object {{object}}, zone {{zone}}"),),
                "lengthmm", 8,
            ),
            Panel(
                "Strokes left",
                ((f"wearline_remaining_strokes{CELL}", "object {{object}}, zone {{zone}}, quantile {{quantile}}"),),
                "none", 8, about="To the limit of the recipe; absent while the trend does not say.",
            ),
            Panel(
                "Alarm level", ((f"wearline_alarm_level{CELL}", "object {{object}}, zone {{zone}}"),), "none", 12,
                "stat", "0 nothing, 1 info, 2 warning, 3 action, 4 stop.", ((None, GREEN), (2, YELLOW), (3, RED)),
            ),
            Panel(
                "Strokes since the die was serviced",
                ((f"wearline_strokes_since_service{CELL}", "object {{object}}"),), "none", 12, "stat",
            ),
        ),
    ),
    (
        "Where the time goes", 8,
        (
            Panel(
                "Cycle",
                (
                    (f"cell:wearline_cycle_seconds:p50_10m{CELL}", "half of them"),
                    (f"cell:wearline_cycle_seconds:p99_10m{CELL}", "99 of 100"),
                ),
                "s", 8,
            ),
            Panel(
                "Handling, 99 of 100",
                (
                    (
                        f"histogram_quantile(0.99, {sums('wearline_handling_seconds_bucket', 'service, topic, le')})",
                        "{{service}} {{topic}}",
                    ),
                ),
                "s", 8,
            ),
            Panel(
                "Polls of the PLC, 99 of 100",
                ((f"histogram_quantile(0.99, {sums('wearline_plc_poll_seconds_bucket', 'le')})", "poll"),), "s", 8,
            ),
        ),
    ),
    (
        "The bus and the disk", 8,
        (
            Panel(
                "Messages received",
                (
                    (
                        sums("wearline_messages_total", "service, topic", where=', direction="in"'),
                        "{{service}} {{topic}}",
                    ),
                ),
                "ops", 8,
            ),
            Panel(
                "Left out",
                (
                    (
                        sums("wearline_dropped_total", "service, topic, reason"),
                        "{{service}} {{topic}} {{reason}}",
                    ),
                ),
                "ops", 4,
            ),
            Panel(
                "Since the last message", ((f"wearline_topic_age_seconds{CELL}", "{{service}} {{topic}}"),), "s", 6,
            ),
            Panel(
                "Free on disk",
                ((f"wearline_disk_free_bytes{CELL} / wearline_disk_size_bytes{CELL}", "{{service}}"),),
                "percentunit", 6,
                steps=((None, RED), (0.1, YELLOW), (0.2, GREEN)),
            ),
        ),
    ),
)  # fmt: skip


def drawn(panel: Panel, number: int, x: int, y: int, height: int) -> dict[str, Any]:
    """One panel as Grafana reads it."""
    mappings = [
        {"type": "value", "options": {value: {"text": text, "color": colour, "index": index}}}
        for index, (value, (text, colour)) in enumerate(panel.words.items())
    ]
    is_stat = panel.kind == "stat"
    defaults: dict[str, Any] = {
        "unit": panel.unit,
        "mappings": mappings,
        "color": {"mode": "thresholds" if is_stat else "palette-classic"},
        "thresholds": {
            "mode": "absolute",
            "steps": [{"value": value, "color": colour} for value, colour in panel.steps],
        },
    }
    if not is_stat:
        defaults["min"] = 0
        defaults["custom"] = {"lineWidth": 1, "fillOpacity": 8, "showPoints": "never", "spanNulls": False}
    options: dict[str, Any] = (
        {
            "colorMode": "background",
            "graphMode": "none",
            "reduceOptions": {"calcs": ["lastNotNull"]},
            "textMode": "auto",
        }
        if is_stat
        else {"legend": {"displayMode": "list", "placement": "bottom"}, "tooltip": {"mode": "multi", "sort": "desc"}}
    )
    return {
        "id": number,
        "type": panel.kind,
        "title": panel.title,
        "description": panel.about,
        "datasource": SOURCE,
        "gridPos": {"x": x, "y": y, "w": panel.width, "h": height},
        "targets": [
            {"refId": chr(ord("A") + index), "expr": expression, "legendFormat": legend, "datasource": SOURCE}
            for index, (expression, legend) in enumerate(panel.queries)
        ],
        "fieldConfig": {"defaults": defaults, "overrides": []},
        "options": options,
    }


def dashboard() -> dict[str, Any]:
    """The whole dashboard: rows of panels, 24 units wide."""
    panels: list[dict[str, Any]] = []
    y = 0
    for title, height, row in ROWS:
        panels.append(
            {
                "id": len(panels) + 1, "type": "row", "title": title, "collapsed": False, "panels": [],
                "gridPos": {"x": 0, "y": y, "w": 24, "h": 1},
            }
        )  # fmt: skip
        y, x = y + 1, 0
        for panel in row:
            if x + panel.width > 24:
                x, y = 0, y + height
            panels.append(drawn(panel, len(panels) + 1, x, y, height))
            x += panel.width
        y += height
    return {
        "uid": "wearline-cell",
        "title": "Wearline cell",
        "tags": ["wearline"],
        "schemaVersion": 38,
        "version": 1,
        "editable": True,
        "refresh": "10s",
        "time": {"from": "now-3h", "to": "now"},
        "timezone": "browser",
        "templating": {
            "list": [
                {"name": "source", "label": "Prometheus", "type": "datasource", "query": "prometheus"},
                {
                    "name": "cell", "label": "Cell", "type": "query", "datasource": SOURCE, "refresh": 2, "sort": 1,
                    "query": {"query": "label_values(wearline_service_up, cell)", "refId": "cell"},
                },
            ]
        },
        "annotations": {
            "list": [
                {
                    "name": "Alerts", "enable": True, "iconColor": RED, "datasource": SOURCE,
                    "expr": 'ALERTS{alertstate="firing", cell="$cell"}', "titleFormat": "{{alertname}}",
                    "textFormat": "{{service}}",
                }
            ]
        },
        "panels": panels,
    }  # fmt: skip


if __name__ == "__main__":
    sys.stdout.write(json.dumps(dashboard(), indent=1) + "\n")
