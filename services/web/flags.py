"""The flags of `mrcdrl web`, apart from what it imports: help and completion come at once."""

from pathlib import Path

from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flags,
    add_transport_flag,
    whole_number,
)
from mrcdrl.common.runtime.completion import completed_by
from mrcdrl.common.runtime.hosts import in_url
from mrcdrl.common.runtime.runs import LATEST, add_run_dir, run_names

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8650
TOKEN_VARIABLE = "MRCDRL_WEB_TOKEN"


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl web", description="Show runs in a browser, live and from records.")
    shown = made.add_argument(
        "shown",
        nargs="?",
        metavar="RUN|FOLDER",
        help=f"a run: name, path or {LATEST}; or a folder of runs",
    )
    completed_by(shown, run_names)
    add_run_dir(made)
    add_serving(made)
    made.add_argument(
        "--connect",
        metavar="ENDPOINT",
        action="append",
        help="for runs that record none here, such as tcp/HOST:7447",
    )
    add_transport_flag(made)
    add_config_flags(made, only=("transport",))
    return made


def add_serving(made: Parser) -> None:
    """Add the flags that say where a page is served, and who may read it."""
    made.add_argument(
        "--host",
        metavar="HOST",
        default=DEFAULT_HOST,
        help=f"address to listen on; default: {DEFAULT_HOST}, this machine only",
    )
    made.add_argument(
        "--port",
        metavar="N",
        type=whole_number(0, 65_535),
        help=f"default: {DEFAULT_PORT}, or any free one if it is in use",
    )
    made.add_argument(
        "--token",
        metavar="TEXT",
        help=f"required of browsers; also {TOKEN_VARIABLE}; generated for other hosts",
    )
    made.add_argument(
        "--name",
        metavar="HOST",
        action="append",
        default=[],
        help="another name by which browsers reach this server",
    )
    for flag, text in (
        ("certificate", "of this server, for HTTPS"),
        ("key", "its key"),
        ("client-ca", "authority of browsers' certificates, instead of a token"),
    ):
        made.add_argument(f"--https-{flag}", metavar="FILE", type=Path, help=text)


def page_address(host: str, port: int, path: str, *, secure: bool = False) -> str:
    """The address that a browser is given."""
    return f"{'https' if secure else 'http'}://{in_url(host)}:{port}/{path}"
