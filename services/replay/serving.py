"""The command line of `mrcdrl replay`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from mrcdrl.common.config import Config, TransportConfig, load_config, refuse_changes
from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flag,
    add_config_flags,
    overrides,
    whole_number,
)
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.runtime.runs import add_run, run_path
from mrcdrl.common.sync.joining import recorded_endpoint
from mrcdrl.common.transport.keys import Keys

_SHOWN = (  # in the short help
    "replay.capacity",
    "replay.min_size",
    "replay.samples_per_insert",
    "replay.sampler",
    "replay.shards",
    "replay.fsync",
)


@dataclass(frozen=True, slots=True)
class Serving:
    """What a replay process needs to serve its run."""

    run: str
    worker: str
    shard: int
    run_dir: Path  # of this run
    config: Config
    transport: TransportConfig

    @classmethod
    def from_argv(cls, argv: Sequence[str]) -> Self:
        """Parse the command line.

        Raises EndpointError if the flags, the configuration and the run directory name no endpoint,
        RunDirectoryError if they change what the records in that directory depend on.
        """
        made = parser()
        arguments = made.parse_args(argv)
        run_dir = run_path(arguments.run, arguments.run_dir)
        own = _config_of(run_dir)
        config = load_config(arguments.config or own, overrides(arguments))
        if own is not None:
            refuse_changes(run_dir, load_config(own, environ={}), config)
        listen, connect = tuple(arguments.listen or ()), tuple(arguments.connect or ())
        if not (listen or connect):
            listen, connect = config.transport.listen, config.transport.connect
        if not (listen or connect):
            listen = (recorded_endpoint(run_dir, "--listen"),)
        transport = config.transport.model_copy(update={"listen": listen, "connect": connect})
        shard = arguments.shard
        if not 0 <= shard < config.replay.shards:
            made.error(f"--shard {shard}: the run has {config.replay.shards} (replay.shards)")
        worker = check_name(arguments.id or f"replay-{shard}", "--id")
        return cls(run_dir.name, worker, shard, run_dir, config, transport)

    @property
    def keys(self) -> Keys:
        return Keys(self.run)

    @property
    def log_directory(self) -> Path:
        return self.run_dir / "replay" / str(self.shard)


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl replay", description="Serve the replay table of a run.")
    add_run(made)
    add_config_flag(made, None, of_run=True)
    made.add_argument(
        "--listen", metavar="ENDPOINT", action="append", help="such as tcp/127.0.0.1:7447"
    )
    made.add_argument(
        "--connect", metavar="ENDPOINT", action="append", help="a router's, instead of --listen"
    )
    made.add_argument(
        "--shard",
        metavar="N",
        type=whole_number(0),
        default=0,
        help="number among replay.shards, from 0",
    )
    made.add_argument("--id", help="this worker's name; default: from the shard")
    add_config_flags(made, _SHOWN)
    return made


def _config_of(run_dir: Path) -> str | None:
    """The configuration file of the run directory, if it has one."""
    path = run_dir / RUN_CONFIG
    return str(path) if path.is_file() else None
