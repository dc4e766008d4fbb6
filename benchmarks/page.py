"""What the page costs a run, and how soon it shows one.

    setsid -w python -m benchmarks.page --rounds 3 --seconds 60
    setsid -w python -m benchmarks.page --browser

Trains as `mrcdrl train` does, with its page, and alternates phases: nobody watches, one viewer,
nobody, twenty do. A viewer takes the state and an actor's frames, as a page does, without drawing
them. People watch from other machines, so viewers take only cores that the run leaves, where the
command leads its session (`setsid`). Of each phase: learner steps a second as recorded, frames a
second that a viewer got, and the share of a core that the server took. With --browser also how long
a page takes to load, to show its first picture and curves, in Chromium: the first one that it
opens, and those opened from the list of runs afterwards, as people do. Prints one line of JSON per
phase, then medians on stderr.
"""

import argparse
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import urlsplit

from benchmarks.machine import emit
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.process import yield_cores
from mrcdrl.services.monitor.records import read_last_metrics
from tests.patience import eventually
from tests.system.system_processes import Command, end_all, processes_of, run_name

PHASES = {"nobody": 0, "one": 1, "nobody again": 0, "twenty": 20}
_VIEWERS_NICE = 19
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_FROM_THE_LIST = 3  # openings
_SETTLE_S = 12.0  # longer than a run is followed after its last viewer
# Notes in the page when it has loaded, and when curves and a picture are first there.
_NOTE_TIMES = """
    const noted = (window.noted = {});
    const find = (place) => document.querySelector(place);
    const there = {
        loaded: () => document.readyState === "complete",
        curves: () => find("#charts canvas"),
        picture: () => /episode \\d+ · frame \\d+/.test(find("#moment")?.textContent),
    };
    const look = () => {
        for (const what in there)
            if (!noted[what] && there[what]()) noted[what] = Date.now() / 1000;
        setTimeout(look, 5);
    };
    look();
"""


class Viewer(Closing):
    """Takes what a page takes, in a thread of its own."""

    def __init__(self, port: int, run: str) -> None:
        self.frames = 0
        self._connection = HTTPConnection("127.0.0.1", port, timeout=60)
        path = f"/api/runs/{run}/live?role=actor&worker=actor-0"
        self._connection.request("GET", path)
        self._answer = self._connection.getresponse()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def close(self) -> None:
        """Leave."""
        self._stop.set()
        self._thread.join()
        self._connection.close()

    def _read(self) -> None:
        for line in self._answer:
            self.frames += line.startswith(b"event: frame")
            if self._stop.is_set():
                return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="quick")
    parser.add_argument("--robots", default="2")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a phase")
    parser.add_argument("--browser", action="store_true", help="time a page in Chromium, too")
    arguments = parser.parse_args()
    name, found = run_name("page"), dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as owned:
        owned.callback(end_all, name)
        run = Path(folder) / name
        words = ["--config", arguments.config, "--robots", arguments.robots]
        words += ["--minutes", "0", "--learner-steps", "0", "--run.target_success_rate", "0"]
        words += ["--run-dir", folder, "--name", name]
        train = owned.enter_context(Command(["train", *words], Path(folder)))
        port = eventually(lambda: port_of(train.err), "the page's address")
        eventually(lambda: learner_steps(run) > 0, "the first learner steps", 900.0)
        (server,) = processes_of(str(run), " web ")
        if arguments.browser:
            for opened, times in in_browser(port, name):
                emit({"bench": "page", "opened": opened, "browser": times})
        yield_cores(_VIEWERS_NICE)  # as if viewers were on other machines
        for number in range(arguments.rounds):
            for phase, viewers in PHASES.items():
                figures = measured(run, port, server, viewers, arguments.seconds)
                found.setdefault(phase, []).append(figures["learner_steps_per_s"])
                emit({"bench": "page", "round": number, "phase": phase, **figures})
    for phase, rates in found.items():
        share = median(rates) / median(found["nobody"])
        sys.stderr.write(f"{phase:14} {median(rates):8.1f} learner steps/s, {share:6.1%}\n")


def measured(run: Path, port: int, server: int, num_viewers: int, seconds: float) -> dict[str, Any]:
    """Figures of a phase with so many viewers."""
    with ExitStack() as watching:
        viewers = [watching.enter_context(Viewer(port, run.name)) for _ in range(num_viewers)]
        time.sleep(_SETTLE_S)
        before, busy_s = read_last_metrics(run), cpu_s(server)
        frames = [viewer.frames for viewer in viewers]
        started = time.monotonic()
        time.sleep(seconds)
        lasted_s = time.monotonic() - started
        after, spent_s = read_last_metrics(run), cpu_s(server) - busy_s
        shown = [v.frames - count for v, count in zip(viewers, frames, strict=True)]
    steps = after["learner_steps"] - before["learner_steps"]
    return {
        "viewers": num_viewers,
        "learner_steps_per_s": steps / (after["time_s"] - before["time_s"] or lasted_s),
        "server_cores": spent_s / lasted_s,
        "frames_per_s": median(shown) / lasted_s if shown else None,
    }


def in_browser(port: int, name: str) -> Iterator[tuple[str, dict[str, float]]]:
    """Seconds from asking for the page until it is loaded, has curves, and a picture."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        path = "/usr/bin/chromium"
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page()
        page.add_init_script(_NOTE_TIMES)

        def times(ask: Callable[[], object]) -> dict[str, float]:
            started = time.time()
            ask()
            page.wait_for_function("() => Object.keys(noted).length === 3")
            noted: dict[str, float] = page.evaluate("noted")
            return {f"{what}_s": at_s - started for what, at_s in sorted(noted.items())}

        yield "first", times(lambda: page.goto(f"http://127.0.0.1:{port}/run?name={name}"))
        for _ in range(_FROM_THE_LIST):
            page.goto(f"http://127.0.0.1:{port}/")
            page.wait_for_selector(f"a[href*={name}]")
            time.sleep(_SETTLE_S)
            yield "from the list", times(page.locator(f"a[href*={name}]").first.click)
        browser.close()


def port_of(text: str) -> int | None:
    """The port in what `mrcdrl train` says of its page."""
    address = text.partition("watch it at ")[2].split()
    return urlsplit(address[0]).port if address else None


def learner_steps(run: Path) -> int:
    return int(read_last_metrics(run).get("learner_steps") or 0) if run.is_dir() else 0


def cpu_s(pid: int) -> float:
    """Seconds of a core that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


if __name__ == "__main__":
    main()
