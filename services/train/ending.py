"""What `mrcdrl train` says at the end of a run: the result, what to do next, and the files.

Invariant: only files that exist are named.
"""

import json
import shlex
from pathlib import Path

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.runtime.files import BEST_WEIGHTS, FILM, PICTURES
from mrcdrl.common.runtime.files import reason as failure
from mrcdrl.common.runtime.runs import runs_folder
from mrcdrl.services.monitor.recorder import SUMMARY
from mrcdrl.services.monitor.records import read_last_metrics
from mrcdrl.services.monitor.run_info import best_evaluation
from mrcdrl.services.monitor.stopping import rule_of

_FILES = (SUMMARY, str(BEST_WEIGHTS), *PICTURES, FILM)


def ending(run_dir: Path, reason: str) -> str:
    """The text, a line for each thing to know. reason: why the run ended."""
    word = _word(run_dir)
    metrics = read_last_metrics(run_dir)
    lines = [("ended", reason), ("success", _success(run_dir))]
    if metrics.get("successes_per_100") is not None:
        lines.append(("training", f"{metrics['successes_per_100']:.0f} of 100 episodes at the end"))
    if metrics:
        minutes, steps = metrics["time_s"] / 60, metrics["learner_steps"]
        lines.append(("took", f"{minutes:.1f} minutes, {steps} learner steps"))
    if any(run_dir.glob("checkpoints/*")):
        lines += [
            ("next", f"mrcdrl evaluate {word}"),
            ("", f"mrcdrl render {word} --out {shlex.quote(run_dir.name)}.mp4"),
        ]
    lines.append(("" if lines[-1][0] == "" else "next", f"mrcdrl web {word}"))
    resume = f"mrcdrl train --resume {word}{_other_limit(reason)}"
    lines.append(("" if lines[-1][0] == "" else "next", resume))
    files = [name for name in _FILES if (run_dir / name).is_file()]
    lines.append(("files", f"{run_dir}{': ' * bool(files)}{', '.join(files)}"))
    return "".join(f"{name:<9} {said}\n" for name, said in lines)


def ending_as_json(run_dir: Path) -> str:
    """The run's summary as one line; raises RunDirectoryError if none could be written."""
    try:
        return f"{json.dumps(json.loads((run_dir / SUMMARY).read_bytes()))}\n"
    except OSError as error:
        raise RunDirectoryError(f"{run_dir} has no {SUMMARY} to print: {failure(error)}") from error


def _success(run_dir: Path) -> str:
    best = best_evaluation(run_dir)
    if best is None:
        return "no evaluation came to its end"
    low, high = best["success_interval"]
    return (
        f"{100 * best['success_rate']:.1f} % of {best['episodes']} episodes (95 % interval "
        f"{100 * low:.1f} to {100 * high:.1f}), by the weights of learner step "
        f"{best['learner_step']}, the best"
    )


def _word(run_dir: Path) -> str:
    """What names the run to a command: its name, or its path where it is not in the folder."""
    here = run_dir.parent.resolve() == runs_folder().resolve()
    return shlex.quote(run_dir.name if here else str(run_dir))


def _other_limit(reason: str) -> str:
    """Flags without which a run that reached its limit would not go on."""
    rule = rule_of(reason)
    steps = " --learner-steps 0" * (rule == "steps")
    return f" --minutes 30{steps}" * bool(rule)
