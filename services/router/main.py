"""`mrcdrl router`: a Zenoh router that all processes of a run connect to."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from mrcdrl.common.config import load_transport
from mrcdrl.common.config.arguments import Parser, add_config_flags, add_transport_flag, overrides
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.stats import serve_statistics
from mrcdrl.common.transport import ROUTER_FILE, AccessLog, Session

_TICK_S = 1.0


def main(argv: Sequence[str]) -> int:
    """Relay until told to stop; return the exit code."""
    arguments = parser().parse_args(argv)
    given = load_transport(overrides(arguments), source=arguments.transport)
    transport = given.model_copy(
        update={
            "listen": tuple(arguments.listen or given.listen),
            "connect": tuple(arguments.connect or given.connect),
        }
    )
    heartbeat = Heartbeat.from_environment()
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with ExitStack() as owned:
        if transport.key:
            owned.enter_context(AccessLog())
        owned.enter_context(Session(transport, router_file=arguments.config))
        owned.enter_context(serve_statistics(transport, "router"))
        while not stop.wait(_TICK_S):
            heartbeat.worked()
            heartbeat.beat()
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl router", description="Relay between the processes of runs.")
    made.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        default=ROUTER_FILE,
        help="Zenoh's settings; default: the installed router.json5",
    )
    made.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        help="such as tcp/0.0.0.0:7447; default: the file's",
    )
    made.add_argument(
        "--connect",
        metavar="ENDPOINT",
        action="append",
        help="another router, to link to once it is up",
    )
    add_transport_flag(made)
    add_config_flags(made, only=("transport",))
    return made
