"""Compare our replay service with its peers, in turn and in rounds, on the same cores.

    python -m benchmarks.replay_peers --peers DIR --cores 0,1 --reverb-python P --zmq-python P

DIR is the directory of the harness, with `replay_reverb.py` and `replay_zmq.py`; each peer has its
own Python with its requirements installed. Each system prints a line of JSON per round; then a
table of medians goes to stderr, in thousands of transitions a second.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

OURS = {
    "ours frames": ("--codec", "frames"),
    "ours frames, no log": ("--codec", "frames", "--fsync", "off"),
    "ours frames, network": ("--codec", "frames", "--network"),
    "ours records": ("--codec", "records"),
    "ours drawn": ("--codec", "drawn"),
}
REVERB = ("--flush", "50", "--workers", "2", "--chunk-length", "5")
COLUMNS = {
    "insert": "insert_per_s",
    "sample b32": "sample_b32_per_s",
    "b32 + priorities": "sample_update_b32_per_s",
    "sample b512": "sample_b512_per_s",
    "b512 + priorities": "sample_update_b512_per_s",
    "both: sample": "both_sample_b512_per_s",
    "both: insert": "both_insert_per_s",
    "MB / 100 k": "server_MB_per_100k",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path, required=True)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--reverb-python")
    parser.add_argument("--zmq-python")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--seconds", default="1.2")
    parser.add_argument("--reps", default="5")
    parser.add_argument("--only", nargs="+", help=f"of {', '.join(OURS)}", default=list(OURS))
    arguments = parser.parse_args()
    timing = ["--seconds", arguments.seconds, "--reps", arguments.reps]
    commands: dict[str, list[str]] = {}
    if arguments.zmq_python:
        script = str(arguments.peers / "replay_zmq.py")
        commands["ZeroMQ + numpy ring"] = [arguments.zmq_python, script, *timing]
    if arguments.reverb_python:
        script = str(arguments.peers / "replay_reverb.py")
        commands["Reverb"] = [arguments.reverb_python, script, *timing, *REVERB]
    for name in arguments.only:
        module = [sys.executable, "-m", "benchmarks.replay", "--peers", str(arguments.peers)]
        commands[name] = [*module, *timing, *OURS[name]]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in commands}
    for number in range(arguments.rounds):
        for name, command in commands.items():
            result = run(["taskset", "-c", arguments.cores, *command])
            print(json.dumps({"system": name, "round": number, **result}), flush=True)
            found[name].append(result)
            sys.stderr.write(f"round {number}: {name}: {result.get('error', 'done')}\n")
    sys.stderr.write(table(found))


def run(command: list[str], **variables: str) -> dict[str, Any]:
    """The last line of JSON that the command prints; {"error"} if it prints none.

    variables: added to this process's environment.
    """
    environment = {**os.environ, **variables}
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, timeout=1200
    )
    lines = [line for line in ended.stdout.splitlines() if line.startswith("{")]
    if not lines:
        return {"error": (ended.stderr.splitlines() or ["no output"])[-1]}
    result: dict[str, Any] = json.loads(lines[-1])
    return result


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """A table of medians over the rounds, in thousands a second."""
    lines = [f"{'':24}" + "".join(f"{name:>18}" for name in COLUMNS)]
    for name, results in found.items():
        cells = (figure(results, key) for key in COLUMNS.values())
        lines.append(f"{name:24}" + "".join(f"{cell:>18}" for cell in cells))
    return "\n".join(lines) + "\n"


def figure(results: list[dict[str, Any]], key: str) -> str:
    values = [result[key] for result in results if key in result]
    if not values:
        return "-"
    if isinstance(values[0], dict):
        return f"{statistics.median(value['median'] for value in values) / 1000:.1f}"
    return f"{statistics.median(values):.0f}"


if __name__ == "__main__":
    main()
