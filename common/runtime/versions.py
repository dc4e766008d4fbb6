"""Which versions of what a process runs with; nothing is imported for it."""

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = {"mrcdrl": "mrcdrl", "zenoh": "eclipse-zenoh", "numpy": "numpy", "torch": "torch"}


def installed(package: str) -> str | None:
    """The version of a distribution; None where it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """By name: Python's, and those of PACKAGES that are there."""
    there = {name: installed(package) for name, package in PACKAGES.items()}
    found = {name: text for name, text in there.items() if text is not None}
    return {"python": platform.python_version(), **found}
