"""Writes docs/benchmarks.md from the raw lines in benchmarks/results, ours beside our peers'.

    python -m benchmarks.summary                  # from the lines that are there
    python -m benchmarks.summary --measure DIR    # measures what needs no peer first, here

With --measure each benchmark runs once, one after another, for some ten minutes altogether; raw
lines and page are written to DIR, and the repository stays as it is. Where DIR lacks a line, as of
a peer, the committed one stands. Nothing else should run meanwhile.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "benchmarks.md"

Line = Mapping[str, Any]

_MOST_COMMANDS = 4  # under a table

# What --measure runs: arguments of a module of benchmarks, by the file of its raw lines.
MEASURED = {
    "arena/arena.jsonl": ("arena",),
    "learner/quiet.jsonl": ("learner", "--rounds", "0", "--batches", "32", "512"),
    "stages/stages.jsonl": ("stages", "--robots", "2"),
    "system/quiet.jsonl": ("system", "--rounds", "2", "--seconds", "10"),
    "learner-robustness/late-joiners-50.json": ("late_joiners", "--joiners", "50"),
    "thousand/weights-ways.jsonl": ("weights_ways", "--readers", "100", "--rounds", "2"),
}

_TWO_ROBOTS = tuple(f"quick-sooner/2robots-tested-averages-s{seed}.jsonl" for seed in range(3))

# Of 100 000 transitions in chunks of 50, counted by the table that takes it all at its start.
_FRAMES_MB = 388.4


class Lines:
    """Raw lines by file: those of a folder or, where it lacks a file, the committed ones."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder

    def __call__(self, name: str, **wanted: object) -> list[Line]:
        """The lines of a file with these values."""
        path = RESULTS / name
        if self._folder is not None and (self._folder / name).exists():
            path = self._folder / name
        lines: Iterable[Line] = map(json.loads, path.read_text("utf-8").splitlines())
        return [line for line in lines if all(line.get(k) == v for k, v in wanted.items())]


@dataclass(frozen=True, slots=True)
class Row:
    """One figure, ours beside a peer's."""

    what: str
    ours: str
    peer: str = ""
    times: float | None = None  # as good as the peer; below 1: the peer is better


@dataclass(frozen=True, slots=True)
class Table:
    """Figures that were measured together."""

    title: str
    text: str
    rows: Callable[[Lines], list[Row]]
    sources: tuple[str, ...]  # files in results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--measure", type=Path, metavar="DIR", help="measure first, into DIR")
    folder = parser.parse_args().measure
    if folder is not None:
        measure(folder)
    page = PAGE if folder is None else folder / PAGE.name
    page.write_text(text(Lines(folder)), "utf-8")
    print(page)


def measure(folder: Path) -> None:
    """Run each benchmark of MEASURED; keep its raw lines."""
    for name, (module, *arguments) in MEASURED.items():
        print(f"{module} …", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", f"benchmarks.{module}", *arguments]
        out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(out.stdout, "utf-8")


# -- tables ------------------------------------------------------------------------------------


def replay(lines: Lines) -> list[Row]:
    """Transitions a second, in and out."""
    found = lines("replay-peers/raw.jsonl")
    columns = {
        "inserts": "insert_per_s",
        "samples, mini-batches of 32": "sample_b32_per_s",
        "the same with new priorities": "sample_update_b32_per_s",
        "samples, mini-batches of 512, with priorities": "sample_update_b512_per_s",
    }

    def rate(system: str, column: str) -> float:
        of_system = [x for x in found if x["system"] == system and column in x]
        return median(x[column]["median"] for x in of_system)

    rows = []
    for peer in ("Reverb", "ZeroMQ + numpy ring"):
        for what, column in columns.items():
            ours, theirs = rate("ours frames", column), rate(peer, column)
            rows.append(_faster(what, ours, theirs, peer, "k/s", 1e3))
    ours = rate("ours frames, network", "sample_b32_per_s")
    theirs = rate("ZeroMQ + numpy ring", "sample_b32_per_s")
    rows.append(
        _faster("samples without shared memory", ours, theirs, "ZeroMQ + numpy ring", "k/s", 1e3)
    )
    theirs = median(x["server_MB_per_100k"] for x in found if x["system"] == "Reverb")
    ours = _FRAMES_MB
    held = "memory of 100 000 transitions of pictures"
    rows.append(Row(held, f"{ours:.0f} MB", f"{theirs:.0f} MB, Reverb, compressed", theirs / ours))
    scenes = lines("replay-peers/gathered-priorities.jsonl")
    for column, what in (
        ("insert_per_s", "inserts; scenes instead of pictures"),
        ("sample_b32_per_s", "samples, mini-batches of 32; scenes"),
    ):
        mine, its = (
            [x[column]["median"] for x in scenes if x["system"] == system]
            for system in ("ours records", "Reverb")
        )
        rows.append(_faster(what, median(mine), median(its), "Reverb, pictures", "k/s", 1e3))
    return rows


def arena(lines: Lines) -> list[Row]:
    """Robot steps a second, of one core."""
    (found,) = lines("arena/arena.jsonl")
    rates = {name: rate["median"] for name, rate in found["rates"].items()}
    rows = [
        Row(
            f"{robots} robots, physics and pictures",
            f"{rates[f'both_{robots}_robot_steps_per_s'] / 1e3:.0f} k robot steps/s",
            f"{rates[f'literal_both_{robots}_robot_steps_per_s'] / 1e3:.1f} k, the paper's way",
            rates[f"both_{robots}_robot_steps_per_s"]
            / rates[f"literal_both_{robots}_robot_steps_per_s"],
        )
        for robots in (2, 3, 4)
    ]
    if "pusht_pictures_per_s" in rates:
        ours, theirs = rates["drawing_2_robot_steps_per_s"], rates["pusht_pictures_per_s"]
        rows.append(_faster("pictures alone", ours, theirs, "gym-pusht", "k/s", 1e3))
    return rows


def learner(lines: Lines) -> list[Row]:
    """Updates a second of the paper's network, two threads."""
    found = lines("learner/quiet.jsonl")
    rows = []
    for size in (32, 512):

        def rate(system: str, size: int = size) -> float:
            of_system = [x for x in found if x.get("system", "ours, auto") == system]
            rates = [x[f"b{size}_updates_per_s"]["median"] for x in of_system]
            return median(rates) if rates else float("nan")

        for peer in ("CleanRL, tuned", "CleanRL, plain"):
            what = f"mini-batches of {size}"
            rows.append(_faster(what, rate("ours, auto"), rate(peer), peer, "/s", 1))
    return rows


def system(lines: Lines) -> list[Row]:
    """Updates a second of the whole system."""
    turns: dict[str, list[float]] = {}
    for line in lines("system/quiet.jsonl"):
        for name, rates in line["updates_per_s"].items():
            turns.setdefault(name, []).extend(rates)
    rates = {name: median(found) for name, found in turns.items()}
    ours, alone = rates["actors"], rates["alone"]
    rows = [
        Row("with actors, of the learner alone", f"{ours:.1f} /s", f"{alone:.1f} /s, alone",
            ours / alone),
        Row("with an evaluator that always judges, too", f"{rates['actors and evaluator']:.1f} /s",
            f"{alone:.1f} /s, alone", rates["actors and evaluator"] / alone),
    ]  # fmt: skip
    peers = {
        "sb3, the paper's network": "stable-baselines3, the same network",
        "sb3, its network": "stable-baselines3, its own, smaller network",
    }
    for name, peer in peers.items():
        if name in rates:
            rows.append(_faster("updates with actors", ours, rates[name], peer, "/s", 1))
    return rows


def success(lines: Lines) -> list[Row]:
    """Minutes to success in the paper's test."""

    def minutes(name: str, rate: float) -> float | None:
        reached = (x["time_s"] / 60 for x in lines(name) if x["success_rate"] >= rate)
        return next(reached, None)

    (theirs,) = lines("system/sb3-training.jsonl", test_successes_of_100=92)
    never = float("inf")
    ours = median(minutes(name, 0.94) or never for name in _TWO_ROBOTS)
    peer = theirs["cpu_minutes"]
    rows = [
        Row(
            "2 robots, 94 of 100 starts (the peer 92), median of three seeds",
            f"{ours:.1f} min",
            f"{peer:.0f} min of processor time, stable-baselines3",
            peer / ours,
        )
    ]
    for rate in (0.5, 0.75, 0.93, 0.975):
        took = minutes("quick-sooner/4robots-tested-averages-s1.jsonl", rate)
        rows.append(Row(f"4 robots, {100 * rate:g} of 100 starts, one seed", f"{took:.1f} min"))
    return rows


def weights(lines: Lines) -> list[Row]:
    """How soon weights are where they act."""
    (joined,) = lines("learner-robustness/late-joiners-50.json")
    after = joined["weights_after_s"]
    rows = [
        Row(
            f"{joined['joiners']} actors that join late: the newest weights",
            f"{1e3 * after['median']:.0f} ms in the median, {1e3 * after['max']:.0f} at most",
        )
    ]
    ways = lines("thousand/weights-ways.jsonl")
    cost = {
        way: median(x["cpu_ms"] for x in ways if x["way"] == way) for way in ("notice", "pushed")
    }
    rows.append(
        Row(
            "processor time for a reader to get weights, 100 readers on a host",
            f"{cost['notice']:.1f} ms, by notice",
            f"{cost['pushed']:.1f} ms, pushed to each",
            cost["pushed"] / cost["notice"],
        )
    )
    return rows


def thousand(lines: Lines) -> list[Row]:
    """A thousand simulated actors on the same two cores."""
    rows = []
    for name, what in (
        ("embedded", "one replay process"),
        ("router", "over a router"),
        ("shards", "four shards of replay"),
    ):
        (found,) = lines(f"thousand/{name}-1000.json")
        took, age = found["insert_ms"], found["weights_ms"]
        rows.append(
            Row(
                f"{what}: acknowledged transitions",
                f"{found['transitions_per_s'] / 1e3:.1f} k/s, lost {found['lost']}; "
                f"acknowledged after {took['p50']:.0f} ms (p99 {took['p99']:.0f}); "
                f"weights after {age['p50']:.0f} ms (p99 {age['p99']:.0f})",
            )
        )
    return rows


def _faster(what: str, ours: float, theirs: float, peer: str, unit: str, by: float) -> Row:
    """A row of rates, shown divided by `by`."""
    return Row(what, f"{ours / by:.1f} {unit}", f"{theirs / by:.1f} {unit}, {peer}", ours / theirs)


TABLES = (
    Table(
        "Replay",
        "A server, a writer and a sampler on the same two cores; pictures of 60 × 60. Ours keeps "
        "what it acknowledges on disk, the peers keep nothing. Medians over rounds.",
        replay,
        ("replay-peers/raw.jsonl", "replay-peers/gathered-priorities.jsonl"),
    ),
    Table(
        "Arena",
        "One core, 16 arenas. The paper's way draws with OpenCV and crops; gym-pusht is another "
        "arena of pymunk with pictures.",
        arena,
        ("arena/arena.jsonl",),
    ),
    Table(
        "Learner",
        "A step is three forward passes, one backward, and the optimizer; two threads.",
        learner,
        ("learner/quiet.jsonl",),
    ),
    Table(
        "The whole system",
        "Updates a second with everything on two cores, and with parts of it.",
        system,
        ("system/quiet.jsonl",),
    ),
    Table(
        "Time to success",
        "From the start of the command, on two cores; the paper's network, pictures alone, the "
        "paper's test.",
        success,
        (
            *_TWO_ROBOTS,
            "quick-sooner/4robots-tested-averages-s1.jsonl",
            "system/sb3-training.jsonl",
        ),
    ),
    Table(
        "Weights",
        "",
        weights,
        ("learner-robustness/late-joiners-50.json", "thousand/weights-ways.jsonl"),
    ),
    Table(
        "A thousand actors",
        "Simulated: real messages to a real replay service, five transitions a second each.",
        thousand,
        (
            "thousand/embedded-1000.json",
            "thousand/router-1000.json",
            "thousand/shards-1000.json",
        ),
    ),
)


# -- page --------------------------------------------------------------------------------------


def text(lines: Lines) -> str:
    """The page."""
    made = [(table, table.rows(lines)) for table in TABLES]
    parts = [
        "# Benchmarks",
        "<!-- Generated by `python -m benchmarks.summary` from benchmarks/results: run that. -->",
        "Each figure comes from raw lines in the repository; under each table stand machine and "
        "command. *Times* says how many times as good ours is; **bold where the peer is better**. "
        "`python -m benchmarks.summary --measure DIR` measures on your machine what needs no peer, "
        "and writes this page anew to DIR.",
        _where_peers_win([row for _, rows in made for row in rows]),
    ]
    for table, rows in made:
        parts += [f"## {table.title}", table.text, _markdown(rows), _sources(table, lines)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _where_peers_win(rows: list[Row]) -> str:
    worse = [row for row in rows if row.times is not None and row.times < 1]
    if not worse:
        return "No peer is better in any of these figures."
    told = "; ".join(f"{row.what} ({row.peer.partition(', ')[2]})" for row in worse)
    return f"A peer is better in: {told}."


def _markdown(rows: list[Row]) -> str:
    compared = any(row.peer for row in rows)
    head = ["what", "ours", *["beside it", "times"] * compared]
    cells = [
        [row.what, row.ours, *[row.peer, _times(row.times)] * compared]
        if compared
        else [row.what, row.ours]
        for row in rows
    ]
    lines = [head, ["---"] * len(head), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _times(value: float | None) -> str:
    if value is None or value != value:
        return "–"
    return f"**{value:.2f}**" if value < 1 else f"{value:.1f}"


def _sources(table: Table, lines: Lines) -> str:
    """Machines, commands and files, once each."""
    found = [line for name in table.sources for line in lines(name)]
    machines = {
        line["machine"]["cpu"]: line["machine"]["cores"] for line in found if "machine" in line
    }
    commands = sorted({line["command"] for line in found if "command" in line})
    folders = sorted({name.partition("/")[0] for name in table.sources})
    told = []
    if machines:
        told.append("; ".join(f"{cores} cores of {cpu}" for cpu, cores in machines.items()))
    if len(commands) <= _MOST_COMMANDS:
        told += [f"`{command}`" for command in commands]
    else:
        told.append("each line has its command")
    told += [
        f"[{folder}](../benchmarks/results/{folder}/README.md)"
        if (RESULTS / folder / "README.md").exists()
        else f"`benchmarks/results/{folder}`"
        for folder in folders
    ]
    return " · ".join(told)


if __name__ == "__main__":
    main()
