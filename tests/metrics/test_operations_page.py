"""``docs/operations.md`` and the dashboard name exactly the existing metrics."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from skyloop.messages import Failsafe, FlightState, LinkState, Refusal
from skyloop.metrics import FAMILIES

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "operations.md").read_text()
BOARD: dict[str, Any] = json.loads((DOCS / "operations" / "grafana.json").read_text())
QUERIES = [target["expr"] for panel in BOARD["panels"] for target in panel["targets"]]
ALERTS = re.findall(r"^ +expr: (.*)$", PAGE, re.MULTILINE)
ROW = re.compile(r"^\| `(skyloop_\w+)` \| (\w+) \| (.*?) ?\| (.*) \|$", re.MULTILINE)
VALUES = {
    ("skyloop_vehicle_state", "state"): {state.value for state in FlightState},
    ("skyloop_vehicle_link_state", "state"): {state.value for state in LinkState},
    ("skyloop_failsafe", "step"): {step.value for step in Failsafe},
    ("skyloop_commands_refused_total", "reason"): {reason.value for reason in Refusal},
    ("skyloop_command_delay_seconds", "statistic"): {"median", "p99", "max"},
}


def test_the_table_is_the_catalogue() -> None:
    assert [
        (name, kind, re.findall(r"`(\w+)`", labels), meaning) for name, kind, labels, meaning in ROW.findall(PAGE)
    ] == [(family.name, family.kind, list(family.labels), family.meaning) for family in FAMILIES.values()]


@pytest.mark.parametrize("query", [*QUERIES, *ALERTS])
def test_queries_name_metrics_labels_and_values_that_exist(query: str) -> None:
    own = re.findall(r"\b(skyloop_\w+)(?:\{([^}]*)\})?", query)
    assert own or re.search(r"\b(process_\w+|up)\{", query)
    for name, matchers in own:
        family = FAMILIES[name]
        for label, operator, text in re.findall(r'(\w+)\s*(=~|!=|=)\s*"([^"]*)"', matchers):
            assert label in family.labels
            known = VALUES.get((name, label))
            if known is not None and not text.startswith("$"):
                assert set(text.split("|")) <= known, f"{label}{operator}{text}"
        counted = f"rate({name}" in query or f"increase({name}" in query
        assert counted == (family.kind == "counter"), "counters are shown as rates, and only counters"


def test_each_alert_says_what_to_do() -> None:
    alerts = re.findall(r"- alert: (\w+)", PAGE)
    assert len(alerts) == len(ALERTS) > 5
    assert re.findall(r"^\| ([A-Z]\w+) \|", PAGE, re.MULTILINE) == alerts


def test_the_dashboard_can_be_imported() -> None:
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])
    places = [tuple(panel["gridPos"][side] for side in "xy") for panel in BOARD["panels"]]
    assert len(set(places)) == len(places)
    assert all(panel["datasource"]["uid"] == "${datasource}" for panel in BOARD["panels"])
    (variable,) = [one["query"] for one in BOARD["templating"]["list"] if one["name"] == "vehicle"]
    assert variable == "label_values(skyloop_vehicle_info, vehicle)"
