"""`mrcdrl certs`: make an authority and a certificate for each role of a run, for trials."""

import datetime
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config.arguments import Parser, whole_number
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.completion import completed_by

ROLES = ("router", "replay", "learner", "actor", "evaluator", "status", "viewer", "robot")
HOSTS = ("localhost", "127.0.0.1", "::1", "router")


def main(argv: Sequence[str]) -> int:
    """Make the certificates that are missing in a directory; return the exit code."""
    arguments = parser().parse_args(argv)
    if importlib.util.find_spec("cryptography") is None:
        raise ConfigError("needs cryptography, which is not installed: pip install 'mrcdrl[certs]'")
    from mrcdrl.services.tools.certificates import make

    valid = datetime.timedelta(days=arguments.days)
    try:
        made = make(arguments.folder, arguments.role or ROLES, (*HOSTS, *arguments.host), valid)
    except OSError as error:
        raise ConfigError(f"cannot write certificates: {error}") from error
    told = f"{arguments.folder}: made {', '.join(made) or 'nothing, all exist'}"
    print(json.dumps({"folder": str(arguments.folder), "made": made}) if arguments.json else told)
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = Parser(
        prog="mrcdrl certs",
        description="Make an authority and a certificate for each role, for trials.",
    )
    made.add_argument("folder", metavar="DIR", type=Path, help="directory to keep them in")
    made.add_argument(
        "--host",
        metavar="NAME",
        action="append",
        default=[],
        help=f"a name or address of the router besides {', '.join(HOSTS)}",
    )
    role = made.add_argument(
        "--role", metavar="ROLE", action="append", help=f"default: {', '.join(ROLES)}"
    )
    completed_by(role, ROLES)
    made.add_argument(
        "--days",
        metavar="N",
        type=whole_number(1, 36_500),
        default=365,
        help="days of validity; default: 365",
    )
    made.add_argument("--json", action="store_true", help="print JSON")
    return made
