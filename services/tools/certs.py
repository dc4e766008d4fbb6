"""`mrcdrl certs`: an authority and a certificate for each role of a run, for trials."""

import datetime
import importlib.util
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.errors import ConfigError

ROLES = ("router", "replay", "learner", "actor", "evaluator", "status", "robot")
HOSTS = ("localhost", "127.0.0.1", "::1", "router")


def main(argv: Sequence[str]) -> int:
    """Make what is missing in a folder; the exit code."""
    parser = Parser(
        prog="mrcdrl certs",
        description="An authority and a certificate for each role, for trials.",
    )
    parser.add_argument("folder", metavar="DIR", type=Path, help="where they are kept")
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        help=f"a router's name or address besides {', '.join(HOSTS)}",
    )
    parser.add_argument("--role", action="append", help=f"by default {', '.join(ROLES)}")
    parser.add_argument("--days", type=int, default=365, help="that they are valid; default: 365")
    arguments = parser.parse_args(argv)
    if arguments.days < 1:
        parser.error("--days: at least 1")
    if importlib.util.find_spec("cryptography") is None:
        raise ConfigError("needs cryptography, not installed here: pip install 'mrcdrl[certs]'")
    from mrcdrl.services.tools.certificates import make

    valid = datetime.timedelta(days=arguments.days)
    try:
        made = make(arguments.folder, arguments.role or ROLES, (*HOSTS, *arguments.host), valid)
    except OSError as error:
        raise ConfigError(f"cannot write certificates: {error}") from error
    print(f"{arguments.folder}: made {', '.join(made) or 'nothing, all is there'}")
    return 0
