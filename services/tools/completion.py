"""`mrcdrl completion`: print what a shell needs to complete commands, flags and their values."""

from collections.abc import Sequence

from argcomplete.shell_integration import shellcode

from mrcdrl.common.config.arguments import Parser

_SHELLS = ("bash", "zsh", "fish")
_USE = """Print what completes commands, flags, presets and choices. To use it:

  bash:  eval "$(mrcdrl completion bash)"         in ~/.bashrc
  zsh:   eval "$(mrcdrl completion zsh)"          in ~/.zshrc, after compinit
  fish:  mrcdrl completion fish | source          in ~/.config/fish/config.fish"""


def main(argv: Sequence[str]) -> int:
    """Print it; return the exit code."""
    arguments = parser().parse_args(argv)
    print(shellcode(["mrcdrl"], shell=arguments.shell))
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = Parser(prog="mrcdrl completion", description=_USE)
    made.add_argument("shell", metavar="SHELL", choices=_SHELLS, help=", ".join(_SHELLS))
    return made
