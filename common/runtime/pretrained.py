"""The weights that come with the package: mrcdrl/pretrained/NAME, each folder with a card.

    mrcdrl evaluate pretrained:4robots

A folder is what `mrcdrl.common.model.saved_policy` reads: weights in half precision, a manifest,
the configuration that they were trained by, and a card, README.md. Nothing is written.
"""

from importlib import resources
from pathlib import Path

from mrcdrl.common.errors import RunDirectoryError

PREFIX = "pretrained:"
GENERAL = "general"  # for any number of robots


def pretrained_names() -> list[str]:
    """The names of all pretrained weights."""
    folder = _folder()
    if not folder.is_dir():
        return []
    return sorted(path.name for path in folder.iterdir() if (path / "config.toml").is_file())


def pretrained_path(name: str) -> Path:
    """The folder of these weights; raises RunDirectoryError for an unknown name."""
    known = pretrained_names()
    if name not in known:
        told = ", ".join(known) or "none"
        raise RunDirectoryError(f"no pretrained weights {name!r}; there are: {told}")
    return _folder() / name


def pretrained_for(num_robots: int) -> str:
    """The weights that suit this number of robots best.

    Those that were trained with it, or else those for any number, or else of the nearest number.
    Raises RunDirectoryError if there are none at all.
    """
    names = pretrained_names()
    numbers = {int(name.removesuffix("robots")): name for name in names if name != GENERAL}
    if num_robots not in numbers and GENERAL in names:
        return GENERAL
    if not numbers:
        raise RunDirectoryError("this copy of mrcdrl has no pretrained weights")
    return numbers[min(numbers, key=lambda number: abs(number - num_robots))]


def _folder() -> Path:
    return Path(str(resources.files("mrcdrl") / "pretrained"))
