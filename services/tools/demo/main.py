"""`mrcdrl demo`: watch a policy play, live in a browser, and change its arena."""

import argparse
import asyncio
import logging
from collections.abc import Sequence

from mrcdrl.common.config.arguments import overrides
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.model.saved_policy import config_beside, weights_path
from mrcdrl.common.runtime.pretrained import PREFIX, pretrained_for
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.runtime.runs import find_weights
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.demo.app import CHANGE, DemoPage
from mrcdrl.services.tools.demo.playground import Cast, Playground
from mrcdrl.services.tools.subject import subject, trained_with
from mrcdrl.services.web.access import page_access
from mrcdrl.services.web.server import serve

_LOG = logging.getLogger("demo")
_USUAL_ROBOTS = 4


def main(argv: Sequence[str]) -> int:
    """Play until told to stop; return the exit code."""
    arguments = flags.demo().parse_args(argv)
    access = page_access(arguments)
    casting = Casting(arguments)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    listener = access.listen()
    playground = Playground(casting, casting.num_robots, arguments.seed)
    page = DemoPage(playground)

    async def end() -> None:
        playground.channel.end()

    _LOG.info("open %s in a browser; Ctrl-C ends it", access.address(listener, "", {}))
    app = access.guard(page.app(), [CHANGE])
    asyncio.run(serve(app, listener, access.certificates, stop, page.check, end))
    return 0


class Casting:
    """The policy and its arena for a number of robots: the one that is named, or a pretrained."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Raises MrcdrlError for weights that cannot be had."""
        self._arguments = arguments
        asked = overrides(arguments).get("arena.num_robots")
        self._named = arguments.weights is not None
        if self._named:
            self._cast = self._load(arguments.weights)
        else:
            name = pretrained_for(int(asked) if asked and asked.isdecimal() else _USUAL_ROBOTS)
            self._cast = self._load(PREFIX + name)
        self.num_robots = self._cast.subject.config.arena.num_robots

    def __call__(self, num_robots: int) -> Cast:
        """The cast for this number of robots; raises MrcdrlError if there is none."""
        if not self._named:
            name = PREFIX + pretrained_for(num_robots)
            if name != self._cast.name:
                self._cast = self._load(name)
        subject = self._cast.subject.with_robots(num_robots)
        return Cast(subject, self._cast.name, self._cast.trained_with)

    def _load(self, name: str) -> Cast:
        self._arguments.weights = name
        loaded = subject(self._arguments)
        if loaded.config.arena.is_custom:
            raise ConfigError(
                "the page draws the paper's arena: film a custom world with mrcdrl render"
            )
        own = config_beside(weights_path(find_weights(name, self._arguments.run_dir)))
        return Cast(loaded, name, trained_with(own))
