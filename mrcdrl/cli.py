"""`mrcdrl …`: every command under one name, each imported only when it is called.

Invariant: help, completion and the refusal of a wrong flag import a command's flags only.
"""

import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import mrcdrl
from mrcdrl.common.runtime.extras import named_extras
from mrcdrl.common.runtime.process import run_main

if TYPE_CHECKING:
    from mrcdrl.common.config.arguments import Parser


class Command(NamedTuple):
    """Where a command is, within this package, and what it does."""

    module: str  # its main(argv) runs the command
    text: str
    flags: str = ""  # MODULE:FUNCTION that makes its parser; empty: `parser` of its module

    def load(self) -> Callable[[Sequence[str]], int | None]:
        """The function that runs it."""
        main: Callable[[Sequence[str]], int | None] = _module(self.module).main
        return main

    def parser(self) -> "Parser":
        """Make its parser, without importing what the command needs."""
        module, _, function = (self.flags or f"{self.module}:parser").partition(":")
        parser: Parser = getattr(_module(module), function)()
        return parser


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"mrcdrl.{name}")


COMMANDS = {
    "train": Command(
        "services.train.main",
        "train on this machine: all processes, one command",
        "services.train.flags:parser",
    ),
    "experiment": Command("services.tools.experiment.main", "train a grid: settings and seeds"),
    "reproduce": Command(
        "services.tools.reproduce.main",
        "train for the paper's tables and figures, and report",
        "services.tools.reproduce.flags:parser",
    ),
    "runs": Command("services.tools.runs", "show the runs in a folder: state, success, disk"),
    "runs rm": Command("services.tools.runs_rm", "remove runs, after asking"),
    "demo": Command(
        "services.tools.demo.main",
        "watch pretrained robots play, and move what is in their way",
        "services.tools.flags:demo",
    ),
    "evaluate": Command(
        "services.tools.evaluate",
        "run the paper's test on weights or a controller",
        "services.tools.flags:evaluate",
    ),
    "render": Command(
        "services.tools.render",
        "film evaluation episodes",
        "services.tools.flags:render",
    ),
    "report": Command(
        "services.tools.report",
        "plot a run and film its best weights",
        "services.tools.flags:report",
    ),
    "figure": Command(
        "services.tools.figure",
        "plot the paper's figures for runs and controllers",
        "services.tools.flags:figure",
    ),
    "export": Command(
        "services.tools.export",
        "export weights: ONNX, torch.export or TorchScript",
        "services.tools.flags:export",
    ),
    "config": Command(
        "services.tools.config", "print the resolved configuration, explain a setting"
    ),
    "replay": Command(
        "services.replay.main",
        "serve the replay table of a run",
        "services.replay.serving:parser",
    ),
    "replay inspect": Command("services.replay.inspect.main", "show what a run's replay log holds"),
    "status": Command("services.status.main", "show what a live run does, and its bottleneck"),
    "web": Command(
        "services.web.main", "show runs in a browser, live", "services.web.flags:parser"
    ),
    "doctor": Command(
        "services.tools.doctor.main",
        "check this machine and a run, and say how to fix what is wrong",
    ),
    "router": Command("services.router.main", "relay between the processes of runs"),
    "certs": Command("services.tools.certs", "make certificates for trials, one for each role"),
    "simulate": Command("services.tools.simulate.main", "put the load of many actors on replay"),
    "actor": Command(
        "services.actor.main",
        "collect for a live run",
        "common.sync.joining:actor_parser",
    ),
    "learner": Command(
        "services.learner.main",
        "learn for a live run",
        "common.sync.joining:learner_parser",
    ),
    "evaluator": Command(
        "services.evaluator.main",
        "evaluate the live weights of a live run",
        "common.sync.joining:evaluator_parser",
    ),
    "completion": Command(
        "services.tools.completion", "print what completes commands in bash, zsh or fish"
    ),
}
EXIT_CODES = {
    0: "done; a run or service that a signal ended is done too",
    1: "failed, or a check of doctor did; stderr says why in one line",
    2: "the command line or a setting is wrong; nothing was done",
    3: "learning diverged: a restarted learner would diverge again",
    130: "interrupted by Ctrl-C",
    141: "nobody reads the output any more",
}


def main() -> int:
    """Run a command; the exit code."""
    return run_main(_dispatch)


def _dispatch() -> int | None:
    words = sys.argv[1:]
    if "_ARGCOMPLETE" in os.environ:
        from mrcdrl.completion import complete

        complete()
    if not words or words[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"mrcdrl {mrcdrl.__version__}")
        return 0
    name, rest = split(words)
    if name not in COMMANDS:
        sys.stderr.write(f"mrcdrl: {_unknown(name)} (see mrcdrl --help)\n")
        return 2
    command = COMMANDS[name]
    with named_extras():
        command.parser().parse_args(rest)  # a wrong flag is told at once, and so is help
        return command.load()(rest)


def split(words: Sequence[str]) -> tuple[str, list[str]]:
    """The command that begins a command line, of one word or two, and the words after it."""
    length = 2 if " ".join(words[:2]) in COMMANDS else 1
    return " ".join(words[:length]), list(words[length:])


def _unknown(name: str) -> str:
    if name.startswith("-"):
        return f"unknown argument {name}; flags follow the command"
    near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"the commands are {', '.join(COMMANDS)}"
    return f"no command {name!r}; {hint}"


def _usage() -> str:
    return "\n".join(
        [
            "usage: mrcdrl COMMAND [flags]   (also mrcdrl COMMAND --help, mrcdrl --version)",
            "",
            *(f"  {name:<14}  {command.text}" for name, command in COMMANDS.items()),
            "",
            "Results go to stdout, progress and warnings to stderr. Exit codes:",
            "",
            *(f"  {code:<14}  {text}" for code, text in EXIT_CODES.items()),
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
