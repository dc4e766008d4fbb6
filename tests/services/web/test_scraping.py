"""`/metrics`: the runs that are up, as Prometheus reads them."""

from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from mrcdrl.common.config import load_config
from tests.patience import eventually
from tests.services.web.live_run import LiveRun
from tests.services.web.web_server import Served, record_run, served

SMOKE = load_config("smoke", {}, environ={})


def scraped(server: Served) -> dict[str, list[str]]:
    """The runs that each metric tells of."""
    status, headers, body = server.get("/metrics")
    assert status == 200
    assert headers["content-type"].startswith("text/plain")
    return {
        family.name: [sample.labels["run"] for sample in family.samples]
        for family in text_string_to_metric_families(body.decode())
    }


def test_a_scrape_tells_of_the_runs_that_are_up(tmp_path: Path) -> None:
    with LiveRun(tmp_path / "live", SMOKE) as live, served(tmp_path) as server:
        record_run(tmp_path / "ended", SMOKE, seconds=3)
        told = eventually(lambda: scraped(server).get("mrcdrl_replay_transitions"), "replay's size")
        assert told == ["live"]
        assert server.get("/metrics", Host="evil.example")[0] == 421
        assert live.publisher.watched is False
