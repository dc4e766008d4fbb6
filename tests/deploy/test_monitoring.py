"""What is given to Prometheus, Grafana and Compose fits them, and names metrics that exist.

Grafana's own schema is not published as a file: its board is checked by its structure and, with
promtool, by its queries.
"""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from mrcdrl.common.messages.metrics import SCHEMAS, definitions
from mrcdrl.common.sync.exposition import exposed_name
from mrcdrl.services.monitor.prometheus import RUN_FAMILIES
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
MONITORING = ROOT / "deploy" / "monitoring"
Object = dict[str, Any]

BOARD: Object = json.loads((MONITORING / "grafana" / "board.json").read_text("utf-8"))
PANELS: list[Object] = BOARD["panels"]
RULES: list[Object] = yaml.safe_load((MONITORING / "alerts.yml").read_text("utf-8"))["groups"][0][
    "rules"
]
TESTS: Object = yaml.safe_load((MONITORING / "alerts.test.yml").read_text("utf-8"))
QUERIES = [target["expr"] for panel in PANELS for target in panel.get("targets", ())]
SERVED = {family.exposed for family in RUN_FAMILIES} | {
    exposed_name(role, each) for role, schema in SCHEMAS.items() for each in definitions(schema)
}
OTHERS = {"mrcdrl_build_info"}
PORT = "9464"


def run(*command: str | Path) -> str:
    result = subprocess.run(
        command, cwd=MONITORING, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.mark.parametrize("name", ["prometheus.yml", "prometheus-local.yml"])
def test_prometheus_takes_the_configuration(promtool: str, name: str) -> None:
    assert "SUCCESS" in run(promtool, "check", "config", name)


def test_prometheus_takes_the_rules(promtool: str) -> None:
    assert f"{len(RULES)} rules found" in run(promtool, "check", "rules", "alerts.yml")


def test_the_rules_raise_what_they_should(promtool: str) -> None:
    assert "SUCCESS" in run(promtool, "test", "rules", "alerts.test.yml")


def test_every_rule_is_tested_and_described() -> None:
    names = {rule["alert"] for rule in RULES}
    raised = {
        test["alertname"]
        for case in TESTS["tests"]
        for test in case.get("alert_rule_test", ())
        if test["exp_alerts"]
    }
    page = (ROOT / "docs" / "monitoring.md").read_text("utf-8")
    assert raised == names
    assert set(re.findall(r"^\| `(Mrcdrl\w+)`", page, re.M)) == names


@pytest.mark.parametrize("query", [*QUERIES, *(rule["expr"] for rule in RULES)])
def test_a_query_names_metrics_that_are_served(query: str) -> None:
    named = set(re.findall(r"\bmrcdrl_\w+", query))
    assert named <= SERVED
    assert named or re.search(r"\b(process_\w+|ALERTS|up)\b", query)


def test_prometheus_reads_the_board_s_queries(promtool: str, tmp_path: Path) -> None:
    """As recording rules, with Grafana's variables filled in."""
    filled = [q.replace("$run", "quick").replace("$__rate_interval", "1m") for q in QUERIES]
    rules = [{"record": f"board:{i}", "expr": query} for i, query in enumerate(filled)]
    path = tmp_path / "board.yml"
    path.write_text(json.dumps({"groups": [{"name": "board", "rules": rules}]}), "utf-8")
    assert "SUCCESS" in run(promtool, "check", "rules", path)


def test_the_board_has_a_place_and_a_source_for_each_panel() -> None:
    assert BOARD["schemaVersion"] >= 39
    assert {"title", "uid", "time", "templating"} <= BOARD.keys()
    ids = [panel["id"] for panel in PANELS]
    assert len(ids) == len(set(ids))
    taken: set[tuple[int, int]] = set()
    for panel in PANELS:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert max(x for x, _ in cells) < 24
        assert not cells & taken, panel["title"]
        taken |= cells
        for target in panel.get("targets", ()):
            assert target["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
    variables = {variable["name"] for variable in BOARD["templating"]["list"]}
    used = {name for query in QUERIES for name in re.findall(r"\$(\w+)", query)}
    assert used <= variables | {"__rate_interval"}


def test_compose_starts_what_prometheus_asks() -> None:
    base = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))["services"]
    added = yaml.safe_load((ROOT / "compose.monitoring.yml").read_text("utf-8"))["services"]
    asked: set[str] = set()
    scraping = yaml.safe_load((MONITORING / "prometheus.yml").read_text("utf-8"))
    for job in scraping["scrape_configs"]:
        for found in job["dns_sd_configs"]:
            assert str(found["port"]) == PORT
            asked |= set(found["names"])
    assert asked <= base.keys()
    for name in asked:
        settings = added[name]["environment"]
        assert settings["MRCDRL_TRANSPORT__METRICS_PORT"] == PORT
        assert settings["MRCDRL_TRANSPORT__METRICS_ADDRESS"] == "0.0.0.0"
    for name in added.keys() - base.keys():
        assert added[name]["read_only"]
        assert added[name]["cap_drop"] == ["ALL"]
        assert all(port.startswith("127.0.0.1:") for port in added[name]["ports"])
        for volume in added[name]["volumes"]:
            source = volume.split(":")[0]
            assert not source.startswith(".") or (ROOT / source).exists()
