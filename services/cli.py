"""`mrcdrl …`: every command under one name; each is imported only when it is called."""

import importlib
import sys

from common.process import run_main

_COMMANDS = {
    "train": ("services.train.__main__", "train on this machine: all processes, one command"),
    "evaluate": ("services.evaluator.evaluate", "the paper's test for weights or a controller"),
    "render": ("services.evaluator.render", "a film of evaluation episodes"),
    "report": ("services.evaluator.report", "the pictures and the film of a run"),
    "figure": ("services.evaluator.figure", "the paper's pictures of runs and controllers"),
    "export": ("services.evaluator.export", "weights as ONNX, torch.export or TorchScript"),
    "config": ("services.configure", "print the resolved configuration"),
    "replay": ("services.replay.__main__", "serve the replay table of a run"),
    "replay inspect": ("services.replay.inspect", "what the replay log of a run holds"),
    "status": ("services.train.status", "what a run that is up does, and what limits it"),
    "doctor": ("services.doctor.__main__", "what this machine and a run lack, and how to mend it"),
    "router": ("services.router.__main__", "relay between the processes of runs"),
    "certs": ("services.router.certs", "certificates for trials, one for each role"),
    "actor": ("services.actor.__main__", "collect for a run that is up"),
    "simulate": ("services.actor.simulate.__main__", "the load of many actors on replay"),
    "learner": ("services.learner.__main__", "learn for a run that is up"),
    "evaluator": ("services.evaluator.__main__", "judge the live weights of a run that is up"),
}


def main() -> int:
    """Dispatch to a command; the exit code."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0 if arguments else 2
    words = 2 if " ".join(arguments[:2]) in _COMMANDS else 1
    name = " ".join(arguments[:words])
    if name not in _COMMANDS:
        sys.stderr.write(f"mrcdrl: no command {name!r}; there are {', '.join(_COMMANDS)}\n")
        return 2
    command = importlib.import_module(_COMMANDS[name][0])
    return run_main(lambda: command.main(arguments[words:]))


def _usage() -> str:
    lines = [f"  {name:<14} {text}" for name, (_, text) in _COMMANDS.items()]
    head = "usage: mrcdrl COMMAND …   (mrcdrl COMMAND --help for its flags)"
    return "\n".join([head, "", *lines])


if __name__ == "__main__":
    sys.exit(main())
