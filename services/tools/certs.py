"""`mrcdrl certs`: make an authority and a certificate for each role of a run, for trials."""

import datetime
import importlib.util
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config.arguments import Parser, whole_number
from mrcdrl.common.errors import ConfigError

ROLES = ("router", "replay", "learner", "actor", "evaluator", "status", "robot")
HOSTS = ("localhost", "127.0.0.1", "::1", "router")


def main(argv: Sequence[str]) -> int:
    """Make the certificates that are missing in a directory; return the exit code."""
    parser = Parser(
        prog="mrcdrl certs",
        description="Make an authority and a certificate for each role, for trials.",
    )
    parser.add_argument("folder", metavar="DIR", type=Path, help="directory to keep them in")
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        help=f"a name or address of the router besides {', '.join(HOSTS)}",
    )
    parser.add_argument("--role", action="append", help=f"default: {', '.join(ROLES)}")
    parser.add_argument(
        "--days", type=whole_number(1, 36_500), default=365, help="days of validity; default: 365"
    )
    arguments = parser.parse_args(argv)
    if importlib.util.find_spec("cryptography") is None:
        raise ConfigError("needs cryptography, which is not installed: pip install 'mrcdrl[certs]'")
    from mrcdrl.services.tools.certificates import make

    valid = datetime.timedelta(days=arguments.days)
    try:
        made = make(arguments.folder, arguments.role or ROLES, (*HOSTS, *arguments.host), valid)
    except OSError as error:
        raise ConfigError(f"cannot write certificates: {error}") from error
    print(f"{arguments.folder}: made {', '.join(made) or 'nothing, all exist'}")
    return 0
