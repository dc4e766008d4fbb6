"""The flags of `mrcdrl train`, apart from what it imports: help and completion come at once."""

import argparse

from mrcdrl.common.config.arguments import Parser, add_config_flag, add_config_flags
from mrcdrl.common.runtime.completion import completed_by
from mrcdrl.common.runtime.runs import LATEST, add_run_dir, run_names

_SHOWN = (  # in the short help
    "arena.num_robots",
    "run.minutes",
    "run.learner_steps",
    "run.target_success_rate",
    "run.actors",
    "agent.kind",
    "learner.batch_size",
    "learner.device",
)


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl train", description="Train on this machine, with all processes.")
    add_config_flag(made)
    made.add_argument(
        "name", nargs="?", default=argparse.SUPPRESS, metavar="NAME", help="the new run's name"
    )
    made.add_argument("--name", help="the same; default: from preset, robots and time")
    resume = made.add_argument(
        "--resume", metavar="RUN", help=f"go on with this run: name, path or {LATEST}"
    )
    completed_by(resume, run_names)
    made.add_argument(
        "--dry-run", action="store_true", help="print the plan, its time, memory and disk, and end"
    )
    made.add_argument("--json", action="store_true", help="print the summary as JSON at the end")
    made.add_argument(
        "--no-plots",
        action="store_false",
        dest="plots",
        help="no plots or video at the end",
    )
    made.add_argument(
        "--no-web",
        action="store_false",
        dest="page",
        help="start no page for watching the run",
    )
    add_run_dir(made)
    add_config_flags(made, _SHOWN)
    return made
