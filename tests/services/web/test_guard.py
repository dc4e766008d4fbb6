"""Requests that are not those of this server's own pages get nothing."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.services.web.access import _token
from mrcdrl.services.web.flags import parser
from tests.services.web.web_server import Served, record_run, served

SECRET = "correct horse"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("outer") / "runs"
    record_run(made / "one", load_config("smoke", {}, environ={}), seconds=3)
    (made.parent / "secret.toml").write_text("secret", "utf-8")
    record_run(made.parent / "elsewhere", load_config("smoke", {}, environ={}), seconds=3)
    (made / "link").symlink_to(made.parent / "elsewhere")
    (made / "one" / "training.png").symlink_to(made.parent / "secret.toml")
    (made / "one" / "logs").mkdir()
    (made / "one" / "logs" / "x.log").symlink_to(made.parent / "secret.toml")
    return made


@pytest.fixture
def server(folder: Path) -> Iterator[Served]:
    with served(folder) as up:
        yield up


@pytest.mark.parametrize(
    "host", ["127.0.0.1:{port}", "localhost:{port}", "localhost", "[::1]:{port}", "192.168.7.9:80"]
)
def test_a_host_that_is_an_address_or_this_machine_is_answered(server: Served, host: str) -> None:
    assert server.get("/api/runs", Host=host.format(port=server.port))[0] == 200


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "localhost.evil.example", ""],
)
def test_a_foreign_host_is_refused(server: Served, host: str) -> None:
    status, _, body = server.get("/api/runs", Host=host.format(port=server.port))
    assert status == 421
    assert b"runs" not in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_nothing_can_be_changed(server: Served, method: str) -> None:
    status, headers, _ = server.get("/api/runs", method)
    assert (status, headers["allow"]) == (405, "GET, HEAD")


def test_another_site_may_link_but_not_read(server: Served) -> None:
    assert server.get("/api/runs", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="cors")[0] == 403
    assert server.get("/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200
    _, headers, _ = server.get("/api/runs", Origin="https://evil.example")
    assert not [name for name in headers if name.startswith("access-control")]


@pytest.mark.parametrize("path", ["/", "/api/runs", "/nothing", "/static/run.js", "/files/one/x"])
def test_every_answer_has_the_policy(server: Served, path: str) -> None:
    _, headers, _ = server.get(path)
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cache-control"] == "no-store"
    assert "server" not in headers


@pytest.mark.parametrize(
    "path",
    [
        "/files/one/../../secret.toml",
        "/files/one/..%2f..%2fsecret.toml",
        "/files/..%2f/secret.toml",
        "/files/../secret.toml",
        "/files/one/training.png",
        "/files/one/metrics.jsonl",
        "/files/one/%2fetc%2fpasswd",
        "/api/runs/..",
        "/api/runs/%2e%2e",
        "/api/runs/..%2felsewhere",
        "/api/runs/elsewhere",
        "/api/runs/link",
        "/api/runs/link/history",
        "/api/runs/link/live",
        "/api/runs/one%00/history",
        "/static/../app.py",
        "/static/..%2fapp.py",
        "/static/%2e%2e/main.py",
        "/static//etc/passwd",
    ],
)
def test_no_path_leaves_the_folder_of_runs(server: Served, path: str) -> None:
    status, _, body = server.get(path)
    assert status == 404
    assert b"secret" not in body
    assert len(body) < 100


def test_links_that_lead_out_are_neither_listed_nor_read(server: Served) -> None:
    assert [run["name"] for run in server.json("/api/runs")["runs"]] == ["one"]
    assert server.json("/api/runs/one/log") == []


@pytest.mark.parametrize(
    "query", ["points=x", "points=1", "points=999999999", "from=nan", "points=9&to=x"]
)
def test_a_query_that_is_none_is_refused(server: Served, query: str) -> None:
    assert server.get(f"/api/runs/one/history?{query}")[0] == 400


def test_a_token_is_asked_for_once_and_kept_by_a_cookie(folder: Path) -> None:
    with served(folder, token=SECRET) as server:
        for headers in ({}, {"Cookie": "x=y"}, {"Authorization": "Bearer wrong"}):
            status, _, body = server.get("/api/runs", **headers)
            assert status == 401
            assert SECRET.encode() not in body
        assert server.get("/?token=wrong")[0] == 401
        status, headers, _ = server.get("/run?token=correct+horse&name=one")
        assert (status, headers["location"]) == (303, "/run?name=one")
        cookie = headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert server.get("/api/runs", Cookie=cookie.partition(";")[0])[0] == 200
        assert server.get("/api/runs", Authorization=f"Bearer {SECRET}")[0] == 200


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ([], False),
        (["--host", "::1"], False),
        (["--host", "0.0.0.0"], True),
        (["--host", "desk.example"], True),
    ],
)
def test_other_machines_need_a_token(
    words: list[str], asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MRCDRL_WEB_TOKEN", raising=False)
    made = _token(parser().parse_args(words), None)
    assert (made is not None) == asked
    assert made is None or len(made) >= 20
    assert _token(parser().parse_args([*words, "--token", SECRET]), None) == SECRET
