"""Monitoring: rules, dashboards and the compose file agree with the metrics of the service and with the documents."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
import yaml
from ddakf_service.observability.metrics import Metrics

from ..test_docs import headings
from .conftest import COMPOSE, MONITORING, ROOT, program

RULES = yaml.safe_load((MONITORING / "rules.yml").read_text(encoding="utf-8"))
ALERTS = [rule for group in RULES["groups"] for rule in group["rules"]]
DASHBOARDS = sorted((ROOT / "docker/grafana/dashboards").glob("*.json"))
OF_PROMETHEUS = {"up", "ALERTS"}
REGISTRY = Metrics().registry


def exposed() -> dict[str, set[str]]:
    """Labels of each series that the service exposes, by name."""
    found, collectors = {}, REGISTRY._names_to_collectors
    for family in REGISTRY.collect():
        endings = {"counter": ["_total"], "histogram": ["_bucket", "_sum", "_count"]}.get(family.type, [""])
        for ending in endings:
            labels = getattr(collectors.get(family.name + ending), "_labelnames", ())
            found[family.name + ending] = {*labels, *({"le"} if ending == "_bucket" else ())}
    return found


def expressions(dashboard: Path) -> list[str]:
    """The queries of a dashboard's panels, annotations and variables."""
    content = json.loads(dashboard.read_text())
    queries = [target["expr"] for panel in content["panels"] for target in panel["targets"]]
    queries += [annotation["expr"] for annotation in content["annotations"]["list"]]
    return queries + [variable["query"]["query"] for variable in content["templating"]["list"]]


def metrics_in(expression: str) -> set[str]:
    """The names of series in a query."""
    bare = re.sub(r'"[^"]*"|\[[^\]]*\]|\bor\b', "", expression)
    bare = re.sub(r"\b(by|without|on|ignoring)\s*\([^)]*\)", "", bare)
    bare = re.sub(r"\{[^}]*\}", "", re.sub(r",\s*instance\)", ")", bare))
    return {name for name in re.findall(r"\b[a-zA-Z_]\w*\b(?!\s*\()", bare) if not re.fullmatch(r"e\d+", name)}


ALL = [rule["expr"] for rule in ALERTS] + [query for dashboard in DASHBOARDS for query in expressions(dashboard)]


@pytest.mark.parametrize("expression", ALL)
def test_a_query_names_series_that_the_service_exposes(expression):
    names = metrics_in(expression)
    assert names
    assert names <= set(exposed()) | OF_PROMETHEUS


@pytest.mark.parametrize("expression", ALL)
def test_a_query_uses_labels_that_the_series_have(expression):
    labels = set().union(*(exposed().get(name, set()) for name in metrics_in(expression)))
    used = set(re.findall(r"(\w+)\s*(?:=~|!~|!=|=)\s*\"", expression))
    used |= {label for group in re.findall(r"by \(([^)]*)\)", expression) for label in re.split(r",\s*", group)}
    assert used - {"instance", "job", "alertstate"} <= labels


@pytest.mark.parametrize("dashboard", DASHBOARDS, ids=lambda path: path.stem)
def test_a_dashboard_takes_its_windows_from_the_interval_of_the_scrapes(dashboard):
    windows = set(re.findall(r"\[([^\]]*)\]", "".join(expressions(dashboard))))
    assert windows == {"$__rate_interval"}


def test_every_job_has_the_interval_that_the_source_of_the_dashboards_is_given():
    source = yaml.safe_load((ROOT / "docker/grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"][0]
    interval = source["jsonData"]["timeInterval"]
    assert yaml.safe_load((MONITORING / "prometheus.yml").read_text())["global"]["scrape_interval"] == interval
    document = (ROOT / "docs/kubernetes.md").read_text(encoding="utf-8")
    (job,) = yaml.safe_load(re.search(r"```yaml\n(- job_name.*?)```", document, re.DOTALL)[1])
    assert job["scrape_interval"] == interval


def test_every_metric_of_the_service_is_on_a_dashboard():
    shown = set().union(*map(metrics_in, ALL))
    families = {family.name for family in REGISTRY.collect() if family.name.startswith("ddakf_")}
    assert {name for name in families if not any(series.startswith(name) for series in shown)} == set()


def test_every_alert_has_its_page():
    page = ROOT / "docs/operations-alerts.md"
    assert {rule["alert"].lower() for rule in ALERTS} <= headings(page)
    for rule in ALERTS:
        path, _, anchor = rule["annotations"]["runbook"].partition("#")
        assert (ROOT / path, anchor) == (page, rule["alert"].lower())
        assert rule["labels"]["severity"] in ("critical", "warning")


@pytest.mark.parametrize("dashboard", DASHBOARDS, ids=lambda path: path.stem)
def test_a_dashboard_uses_the_provisioned_source_and_its_panels_do_not_overlap(dashboard):
    source = yaml.safe_load((ROOT / "docker/grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"][0]
    content, taken = json.loads(dashboard.read_text()), set()
    assert content["uid"] == dashboard.stem
    for panel in content["panels"]:
        assert panel["datasource"] == {"type": source["type"], "uid": source["uid"]}
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert max(x for x, _ in cells) < 24
        assert not cells & taken
        taken |= cells


def test_what_is_provisioned_is_where_compose_mounts_it():
    grafana = COMPOSE["services"]["grafana"]
    mounted = dict(volume.split(":")[:2][::-1] for volume in grafana["volumes"])
    provider = yaml.safe_load((ROOT / "docker/grafana/provisioning/dashboards/ddakf.yaml").read_text())["providers"][0]
    assert (ROOT / "docker" / mounted[provider["options"]["path"]]).resolve() == DASHBOARDS[0].parent
    home = grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert Path(home).relative_to(provider["options"]["path"]).name in {path.name for path in DASHBOARDS}
    source = yaml.safe_load((ROOT / "docker/grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"][0]
    assert source["url"] == "http://prometheus:9090"


@pytest.mark.slow
@pytest.mark.parametrize("check", [["check", "config", "--syntax-only", "prometheus.yml"], ["check", "rules", "rules.yml"],
                                   ["test", "rules", "rules.test.yml"]], ids=lambda check: " ".join(check[:2]))  # fmt: skip
def test_promtool(check):
    ended = subprocess.run(
        [program("promtool", "prometheus"), *check], cwd=MONITORING, capture_output=True, text=True, timeout=250
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
