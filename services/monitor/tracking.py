"""The process beside a run that talks to its experiment tracker, Trackio or Weights & Biases.

It takes a message a line on its standard input, as `Tracker` sends them, and answers each with a
byte once the tracker has taken it. At the end of its input it ends the tracker's run, in bounded
time.
"""

import importlib
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_ENDING_S = 120  # then the kernel ends this process
_MORE: Mapping[str, Callable[[Mapping[str, Any]], Mapping[str, Any]]] = {  # for a package's init
    "wandb": lambda init: {"group": init["name"]},
    "trackio": lambda _: {"resume": "allow"},
}


class Tracking:
    """The tracker's run, made by the first message."""

    def __init__(self) -> None:
        self._module: Any = None
        self._step = 0

    def take(self, message: Mapping[str, Any]) -> None:
        """Do what a message says."""
        if "init" in message:
            self._module = importlib.import_module(message["module"])
            init = message["init"]
            more = _MORE.get(message["module"])
            self._module.init(**init, **(more(init) if more else {}))
        if "log" in message:
            self._step = max(self._step, message.get("step", 0))
            values = {tag: value for tag, value in message["log"].items() if value is not None}
            self._module.log(values, step=self._step)
        if message.get("files"):
            files = {f"run/{tag}": self._media(Path(p)) for tag, p in message["files"].items()}
            self._module.log(files, step=self._step)

    def finish(self) -> None:
        """End the run."""
        if self._module is not None:
            self._module.finish()

    def _media(self, path: Path) -> Any:
        return (self._module.Image if path.suffix == ".png" else self._module.Video)(str(path))


def main() -> int:
    """Track until the input ends; the exit code."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the recorder says when to end
    answers = os.dup(1)
    os.dup2(2, 1)  # what the tracker prints goes to the log
    tracking = Tracking()
    for line in sys.stdin.buffer:
        tracking.take(json.loads(line))
        os.write(answers, b".")
    signal.alarm(_ENDING_S)
    tracking.finish()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
