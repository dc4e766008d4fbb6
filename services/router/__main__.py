"""`mrcdrl router`: a Zenoh router, to which all processes of a run connect."""

import logging
import sys
from collections.abc import Sequence

from common.arguments import Parser
from common.config import TransportConfig
from common.heartbeat import Heartbeat
from common.process import STOP_DEADLINE_S, StopSignal, run_main
from common.transport import Session

_LOG = logging.getLogger("router")
_TICK_S = 1.0


def main(argv: Sequence[str]) -> int:
    """Relay until told to stop; the exit code."""
    parser = Parser(prog="mrcdrl router", description="Relay between the processes of runs.")
    parser.add_argument(
        "--listen", action="append", required=True, help="endpoint, such as tcp/0.0.0.0:7447"
    )
    parser.add_argument("--connect", action="append", help="another router's endpoint, to link to")
    arguments = parser.parse_args(argv)
    transport = TransportConfig(
        listen=tuple(arguments.listen), connect=tuple(arguments.connect or ())
    )
    heartbeat = Heartbeat.of_environment()
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(transport):
        _LOG.info("listening on %s", ", ".join(transport.listen))
        while not stop.wait(_TICK_S):
            heartbeat.worked()
            heartbeat.beat()
    return 0


if __name__ == "__main__":
    sys.exit(run_main(lambda: main(sys.argv[1:])))
