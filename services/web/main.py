"""`mrcdrl web`: a page to watch runs by, live while they are up."""

import argparse
import asyncio
import logging
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config import load_transport
from mrcdrl.common.config.arguments import overrides
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal, yield_cores
from mrcdrl.common.runtime.runs import find_run, is_run, run_path, runs_folder
from mrcdrl.services.web.access import page_access
from mrcdrl.services.web.app import make_app
from mrcdrl.services.web.flags import parser
from mrcdrl.services.web.folder import RunFolder
from mrcdrl.services.web.following import Runs
from mrcdrl.services.web.scraping import metrics_route
from mrcdrl.services.web.server import serve

_LOG = logging.getLogger("web")
_NICE = 10  # a run goes first where cores are short


def main(argv: Sequence[str]) -> int:
    """Show runs until told to stop; return the exit code."""
    arguments = parser().parse_args(argv)
    access = page_access(arguments)
    transport = load_transport(overrides(arguments), source=arguments.transport)
    if arguments.connect:
        transport = transport.model_copy(update={"connect": tuple(arguments.connect)})
    folder, home = _shown(arguments, may_come=bool(transport.connect))
    stop = StopSignal().listen(STOP_DEADLINE_S)
    yield_cores(_NICE)
    listener = access.listen()
    runs, heartbeat = Runs(transport), Heartbeat.from_environment()

    def each_second() -> None:
        runs.tend()
        heartbeat.worked()
        heartbeat.beat()

    found = RunFolder(folder)
    pages = make_app(found, runs, home=home, routes=[metrics_route(found, runs)])
    query = {"name": home} if home else {}
    address = access.address(listener, "run" if home else "", query)
    _LOG.info("showing %s at %s", folder / home, address)
    app = access.guard(pages)
    asyncio.run(serve(app, listener, access.certificates, stop, each_second, runs.close))
    return 0


def _shown(arguments: argparse.Namespace, *, may_come: bool) -> tuple[Path, str]:
    """The folder of runs, and the name of the run that was asked for, or "".

    may_come: a run that has no directory yet may get one. Raises RunDirectoryError if there is
    neither a run nor a folder of that name.
    """
    word = arguments.shown
    if word is None:
        return runs_folder(arguments.run_dir), ""
    if Path(word).is_dir() and not is_run(Path(word)):
        return Path(word), ""
    find = run_path if may_come else find_run
    path = find(word, arguments.run_dir)
    return path.parent, path.name
