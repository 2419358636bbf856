"""Documentation, alert rules and dashboard name metrics and labels that are exported.

`tests/integration/test_metrics_exported.py` proves that what is declared is exported.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser
import pytest
import yaml

from armident.configs.loading import HERE
from armident.daq.capture.capture_metrics import CAPTURE
from armident.identify.monitoring.reidentify.job_metrics import JOB
from armident.identify.monitoring.worker.worker_metrics import WORKER
from armident.metrics import COMMON

PAGE = Path(__file__).resolve().parents[2] / "docs" / "metrics.md"
RULES = HERE / "prometheus" / "armident.rules.yml"
DASHBOARD = HERE / "grafana" / "armident.json"
DECLARED = {
    f"armident_{metrics.program}_{family.name}": family
    for metrics in (CAPTURE, WORKER, JOB)
    for family in metrics.families
}
LABELS = {name: {*COMMON, *family.labels} for name, family in DECLARED.items()}
OF_PROMETHEUS = {"up": set[str](), "ALERTS": {"alertname", "alertstate", "severity"}}
"""Metrics that Prometheus makes itself."""
ADDED = {"job", "instance"}
"""Labels that Prometheus adds to every metric."""
MACROS = {"$__rate_interval": "5m", "$__range": "1h"}
UNITS = r"seconds|bytes|celsius|ratio|total|info"
"""Last words of the names of metrics with a unit, by Prometheus' conventions, and of counters."""
COUNTED = r"rows|buses|answers|blocks|recordings|value|limit|std|code"
"""Last words of gauges that count something, have the unit of their label, or none."""
YES_OR_NO = r"zenoh_open|clock_synchronised|changed|investigated|verdict"


def queries(found: Any, key: str = "expr") -> Iterator[str]:
    """Values of a key anywhere in rules or dashboard."""
    if isinstance(found, dict):
        for name, value in found.items():
            if name == key and isinstance(value, str):
                yield value
            else:
                yield from queries(value, key)
    elif isinstance(found, list):
        for value in found:
            yield from queries(value, key)


def rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"]
    return [rule for group in groups for rule in group["rules"]]


def labels_of(name: str) -> set[str]:
    """Labels of a metric; an error if nothing exports it."""
    return ADDED | (LABELS | OF_PROMETHEUS)[name]


def check(query: str) -> set[str]:
    """Parse a query, require that its metrics and labels exist, and return the labels of its metrics."""
    for macro, value in MACROS.items():
        query = query.replace(macro, value)
    return checked(promql_parser.parse(query))


def checked(expression: Any) -> set[str]:
    if isinstance(expression, promql_parser.VectorSelector):
        matched = {matcher.name for matcher in expression.matchers.matchers}
        known = ADDED | {*COMMON} if expression.name is None else labels_of(expression.name)
        assert matched <= known | ({"__name__"} if expression.name is None else set()), expression.prettify()
        return known
    children = [getattr(expression, name, None) for name in ("expr", "lhs", "rhs", "param", "vector_selector")]
    parts = [each for each in (*children, *getattr(expression, "args", ())) if isinstance(each, promql_parser.Expr)]
    found = [checked(part) for part in parts]
    known = set.union(*found) if found else set()
    modifier = getattr(expression, "modifier", None)
    for grouped in (modifier, getattr(modifier, "matching", None)):
        named = set(getattr(grouped, "labels", None) or ())
        assert all(named <= labels for labels in found if labels), expression.prettify()
    return known


def test_names_have_the_units_and_suffixes_of_prometheus() -> None:
    for name, family in DECLARED.items():
        assert re.fullmatch(r"armident_[a-z][a-z0-9_]*", name), name
        assert re.search(rf"_({UNITS}|{COUNTED}|{YES_OR_NO})$", name), name
        assert family.help.endswith("."), name
        assert len(family.help.split()) >= 3, name


def test_alert_rules_name_what_is_exported() -> None:
    assert len(rules()) >= 15
    for rule in rules():
        known = check(rule["expr"])
        named = {name for text in rule["annotations"].values() for name in re.findall(r"\$labels\.(\w+)", text)}
        assert named <= known, rule["alert"]
        assert rule["labels"]["severity"] in {"warning", "critical"}
        assert set(rule["annotations"]) == {"summary", "action"}


def test_the_dashboard_names_what_is_exported() -> None:
    dashboard = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    found = 0
    for panel in [*dashboard["panels"], *dashboard["annotations"]["list"]]:
        for target in panel.get("targets", [panel] if "expr" in panel else []):
            texts = " ".join(str(target.get(key, "")) for key in ("legendFormat", "titleFormat", "textFormat"))
            assert set(re.findall(r"\{\{(\w+)\}\}", texts)) <= check(target["expr"]), panel.get("title")
            found += 1
    assert found >= 30
    for variable in dashboard["templating"]["list"][1:]:
        match = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["definition"])
        assert match is not None
        assert match[2] in check(match[1])
        assert variable["query"]["query"] == variable["definition"]


def test_every_query_that_grafana_or_prometheus_asks_was_checked() -> None:
    text = RULES.read_text(encoding="utf-8") + DASHBOARD.read_text(encoding="utf-8")
    asked = [*queries(yaml.safe_load(RULES.read_text())), *queries(json.loads(DASHBOARD.read_text()))]
    asked += queries(json.loads(DASHBOARD.read_text()), "definition")
    named = set(re.findall(r"armident_(?:capture|worker|reidentify)_\w+", text))
    assert named <= set(re.findall(r"\w+", " ".join(asked)))
    assert named <= DECLARED.keys()


@pytest.mark.parametrize(
    "query",
    [
        "armident_capture_frames_per_s",
        'armident_capture_rows_total{bus="can0"}',
        "sum by (joint) (rate(armident_capture_rows_total[5m]))",
        "armident_capture_rows_total / on (bus) armident_capture_frames_total",
    ],
)
def test_a_metric_or_label_that_is_not_exported_is_found(query: str) -> None:
    with pytest.raises((AssertionError, KeyError)):
        check(query)


def test_the_page_has_one_row_for_each_metric_with_type_labels_and_meaning() -> None:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    found = [line for line in lines if line.startswith("| `armident_")]
    wanted = [
        f"| `{name}` | {'counter' if name.endswith('_total') else 'gauge'} "
        f"| {', '.join(f'`{label}`' for label in family.labels)} | {family.help} |"
        for name, family in DECLARED.items()
    ]
    assert found == [" ".join(row.split()) for row in wanted]


def test_the_page_names_every_alert() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(Armident\w+)`", text, re.MULTILINE)) == {rule["alert"] for rule in rules()}


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed (package prometheus)")
def test_prometheus_takes_the_rules() -> None:
    done = subprocess.run(["promtool", "check", "rules", str(RULES)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
