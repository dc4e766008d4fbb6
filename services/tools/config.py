"""`mrcdrl config`: print the configuration that a command with the same flags would use."""

import json
from collections.abc import Sequence

from mrcdrl.common.arena import looked_up
from mrcdrl.common.config import DEFAULT_PRESET, load_config, to_toml
from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flag,
    add_config_flags,
    overrides,
)
from mrcdrl.common.config.explain import explain, explained
from mrcdrl.common.config.settings import all_settings
from mrcdrl.common.runtime.completion import completed_by

_SHOWN = (  # in the short help
    "arena.num_robots",
    "agent.kind",
    "replay.capacity",
    "learner.batch_size",
    "run.minutes",
)


def main(argv: Sequence[str]) -> int:
    """Print it as TOML or JSON, or explain one setting of it; return the exit code."""
    arguments = parser().parse_args(argv)
    source, given = arguments.config or DEFAULT_PRESET, overrides(arguments)
    if arguments.explain is not None:
        facts = explain(arguments.explain, source, given)
        print(json.dumps(facts) if arguments.json else explained(facts))
        return 0
    config = looked_up(load_config(source, given))
    print(config.model_dump_json() if arguments.json else to_toml(config))
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = Parser(
        prog="mrcdrl config",
        description="Print the resolved configuration, or what one setting of it means.",
    )
    add_config_flag(made)
    explained_key = made.add_argument(
        "--explain", metavar="KEY", help="one setting, such as learner.batch_size"
    )
    completed_by(explained_key, [setting.key for setting in all_settings()])
    made.add_argument("--json", action="store_true", help="print JSON")
    add_config_flags(made, _SHOWN)
    return made
