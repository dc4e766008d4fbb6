"""The flags of commands that play episodes, apart from what they import.

Help, completion and the refusal of a wrong flag need no PyTorch, so they come at once.
"""

import sys
from pathlib import Path

from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flag,
    add_config_flags,
    whole_number,
)
from mrcdrl.common.runtime.completion import completed_by
from mrcdrl.common.runtime.pretrained import PREFIX
from mrcdrl.common.runtime.runs import LATEST, add_run, add_run_dir, weights_names
from mrcdrl.services.web.flags import add_serving

CONTROLLERS = ("random", "greedy", "potential_field", "orca", "safe_circle")
FIGURES = ("arena", "views", "trajectories", "comparison", "curves")
_SHOWN = (  # in the short help
    "arena.num_robots",
    "arena.target_layout",
    "arena.num_obstacles",
    "evaluator.epsilon",
)
_ONE_SUBJECT = f"a run (name, path, or {LATEST}), a .safetensors file, or {PREFIX}NAME"
_FIGURE = """Plot the paper's figures of any run, weights or controller.

arena         Fig. 1: a start
views         Fig. 3: how a robot's image is made
trajectories  Fig. 8: episodes of one policy
comparison    Fig. 10: several policies from the same starts
curves        Fig. 7: successes of several runs over training"""


def evaluate() -> Parser:
    """The flags of `mrcdrl evaluate`."""
    made = _one_subject("evaluate", "The paper's test: one collision fails, epsilon 0.01.")
    _add_episodes(made, "to play; default: 1100, as in the paper", 1100)
    made.add_argument(
        "--failures",
        nargs="?",
        type=whole_number(0),
        const=sys.maxsize,
        metavar="N",
        help="describe the first N failures (without N: all), and what share failed in which way",
    )
    made.add_argument(
        "--values", action="store_true", help="also compare action values with returns"
    )
    made.add_argument(
        "--json", action="store_true", help="print JSON, a line for each number of robots"
    )
    add_config_flags(made, _SHOWN)
    return made


def render() -> Parser:
    """The flags of `mrcdrl render`."""
    made = _one_subject("render", "Make a film of evaluation episodes.")
    _add_episodes(made, "to show; default: 4", 4)
    _add_out(made, "film to write: .mp4, .gif, or .rrd for rerun; default: film.mp4", "film.mp4")
    add_config_flags(made, _SHOWN)
    return made


def demo() -> Parser:
    """The flags of `mrcdrl demo`."""
    text = "Watch a policy play, live in a browser; move its robots and targets."
    made = Parser(prog="mrcdrl demo", description=text)
    _add_weights(made, "?", f"{_ONE_SUBJECT}; default: to suit --robots")
    made.set_defaults(controller=None)
    _add_seed(made)
    add_run_dir(made)
    add_config_flag(made, of_run=True)
    add_serving(made)
    add_config_flags(made, _SHOWN)
    return made


def report() -> Parser:
    """The flags of `mrcdrl report`."""
    made = Parser(prog="mrcdrl report", description="Write the plots and the film of a run.")
    add_run(made)
    return made


def figure() -> Parser:
    """The flags of `mrcdrl figure`."""
    made = Parser(prog="mrcdrl figure", description=_FIGURE)
    made.add_argument("figure", metavar="FIGURE", choices=FIGURES, help=", ".join(FIGURES))
    _add_weights(made, "*", f"runs, .safetensors files, or {PREFIX}NAME")
    _add_controller(made, "besides weights, or instead: ", "append", [])
    _add_episodes(made, "to show; default: 12, or 4 to compare", None)
    made.add_argument(
        "--frame",
        metavar="N",
        type=whole_number(0),
        default=40,
        help="of the episode, for views; default: 40",
    )
    _add_out(made, "figure to write: .png or .svg")
    add_run_dir(made)
    add_config_flag(made, of_run=True)
    add_config_flags(made, _SHOWN)
    return made


def export() -> Parser:
    """The flags of `mrcdrl export`."""
    text = "Write weights for other programs, checked on real images."
    made = Parser(prog="mrcdrl export", description=text)
    _add_weights(made, None, _ONE_SUBJECT)
    made.set_defaults(controller=None)
    add_run_dir(made)
    add_config_flag(made, of_run=True)
    _add_out(made, "file to write: .onnx, .pt2 or .ts")
    made.add_argument("--json", action="store_true", help="print JSON")
    add_config_flags(made, ("arena.num_robots",))
    return made


def _one_subject(command: str, description: str) -> Parser:
    """Make a parser with the flags that name weights or a controller, and its arena."""
    made = Parser(prog=f"mrcdrl {command}", description=description)
    _add_weights(made, "?", _ONE_SUBJECT)
    _add_controller(made, "instead of weights: ", "store")
    add_run_dir(made)
    add_config_flag(made, of_run=True)
    return made


def _add_weights(made: Parser, nargs: str | None, text: str) -> None:
    completed_by(made.add_argument("weights", nargs=nargs, help=text), weights_names)


def _add_controller(made: Parser, text: str, action: str, default: list[str] | None = None) -> None:
    flag = made.add_argument(
        "--controller",
        action=action,
        default=default,
        metavar="WORD",
        help=text + ", ".join(CONTROLLERS),
    )
    completed_by(flag, CONTROLLERS)


def _add_episodes(made: Parser, text: str, default: int | None) -> None:
    """Add --episodes and --seed."""
    made.add_argument(
        "--episodes", metavar="N", type=whole_number(1), default=default, help=f"episodes {text}"
    )
    _add_seed(made)


def _add_seed(made: Parser) -> None:
    made.add_argument(
        "--seed",
        metavar="N",
        type=whole_number(0),
        default=0,
        help="of the starts and the exploration; default: 0",
    )


def _add_out(made: Parser, text: str, default: str | None = None) -> None:
    out = None if default is None else Path(default)
    made.add_argument(
        "--out", metavar="FILE", type=Path, required=out is None, default=out, help=text
    )
