"""`mrcdrl …`: every command under one name, each imported only when it is called."""

import importlib
import sys

from mrcdrl.common.runtime.extras import named_extras
from mrcdrl.common.runtime.process import run_main

_COMMANDS = {
    "train": ("mrcdrl.services.train.main", "train on this machine: all processes, one command"),
    "experiment": ("mrcdrl.services.tools.experiment.main", "train a grid: settings and seeds"),
    "runs": ("mrcdrl.services.tools.runs", "show the runs in a folder: state, success, disk"),
    "runs rm": ("mrcdrl.services.tools.runs_rm", "remove runs, after asking"),
    "evaluate": (
        "mrcdrl.services.tools.evaluate",
        "run the paper's test on weights or a controller",
    ),
    "render": ("mrcdrl.services.tools.render", "film evaluation episodes"),
    "report": ("mrcdrl.services.tools.report", "plot a run and film its best weights"),
    "figure": ("mrcdrl.services.tools.figure", "plot the paper's figures for runs and controllers"),
    "export": ("mrcdrl.services.tools.export", "export weights: ONNX, torch.export or TorchScript"),
    "config": ("mrcdrl.services.tools.config", "print the resolved configuration"),
    "replay": ("mrcdrl.services.replay.main", "serve the replay table of a run"),
    "replay inspect": ("mrcdrl.services.replay.inspect.main", "show what a run's replay log holds"),
    "status": ("mrcdrl.services.status.main", "show what a live run does, and its bottleneck"),
    "doctor": (
        "mrcdrl.services.tools.doctor.main",
        "check this machine and a run, and say how to fix what is wrong",
    ),
    "router": ("mrcdrl.services.router.main", "relay between the processes of runs"),
    "certs": ("mrcdrl.services.tools.certs", "make certificates for trials, one for each role"),
    "actor": ("mrcdrl.services.actor.main", "collect for a live run"),
    "simulate": ("mrcdrl.services.tools.simulate.main", "put the load of many actors on replay"),
    "learner": ("mrcdrl.services.learner.main", "learn for a live run"),
    "evaluator": ("mrcdrl.services.evaluator.main", "evaluate the live weights of a live run"),
}


def main() -> int:
    """Run a command; the exit code."""
    return run_main(_dispatch)


def _dispatch() -> int | None:
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0 if arguments else 2
    words = 2 if " ".join(arguments[:2]) in _COMMANDS else 1
    name = " ".join(arguments[:words])
    if name not in _COMMANDS:
        sys.stderr.write(f"mrcdrl: no command {name!r}; the commands are {', '.join(_COMMANDS)}\n")
        return 2
    with named_extras():
        command = importlib.import_module(_COMMANDS[name][0])
        exit_code: int | None = command.main(arguments[words:])
    return exit_code


def _usage() -> str:
    lines = [f"  {name:<14} {text}" for name, (_, text) in _COMMANDS.items()]
    head = "usage: mrcdrl COMMAND …   (mrcdrl COMMAND --help for its flags)"
    return "\n".join([head, "", *lines])


if __name__ == "__main__":
    sys.exit(main())
