"""The flags of `mrcdrl reproduce`, apart from what it imports: help and completion come at once."""

from mrcdrl.common.config.arguments import Parser
from mrcdrl.services.tools.experiment.flags import add_cell_flags
from mrcdrl.services.tools.reproduce.protocol import PARTS, SCALES

ALL, REPORT = "all", "report"


def parser() -> Parser:
    """The command's flags."""
    text = "Train for the paper's tables and figures, and say what became of its claims."
    made = Parser(prog="mrcdrl reproduce", description=text)
    choices = (*PARTS, ALL, REPORT)
    made.add_argument(
        "part",
        nargs="?",
        metavar="PART",
        choices=choices,
        default=ALL,
        help=f"{', '.join(choices)} (trains nothing); default: {ALL}",
    )
    made.add_argument(
        "--scale",
        metavar="SCALE",
        choices=tuple(SCALES),
        default="cpu",
        help=f"{', '.join(SCALES)}: see docs/reproduction.md; default: cpu",
    )
    made.add_argument(
        "--smoke", action="store_true", help="a few learner steps of each kind: do the parts work?"
    )
    add_cell_flags(made, "run", out="runs/reproduce/SCALE", example="duel-*", printed="claims")
    return made
