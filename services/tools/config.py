"""`mrcdrl config`: print the configuration that a command with the same flags would use."""

from collections.abc import Sequence

from mrcdrl.common.config import DEFAULT_PRESET, load_config, to_toml
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides


def main(argv: Sequence[str]) -> int:
    """Print it as TOML; return the exit code."""
    parser = Parser(prog="mrcdrl config", description="Print the resolved configuration.")
    parser.add_argument("--config", default=DEFAULT_PRESET, help="a preset or a TOML file")
    add_config_flags(parser)
    arguments = parser.parse_args(argv)
    print(to_toml(load_config(arguments.config, overrides(arguments))))
    return 0
