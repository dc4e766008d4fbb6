"""Versions of the packages that a process runs with, found without importing them."""

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = {"mrcdrl": "mrcdrl", "zenoh": "eclipse-zenoh", "numpy": "numpy", "torch": "torch"}
VERSIONED = ("python", *PACKAGES)


def installed(package: str) -> str | None:
    """The version of a distribution; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions by name: Python's, and those of PACKAGES that are installed."""
    found = {name: installed(package) for name, package in PACKAGES.items()}
    present = {name: text for name, text in found.items() if text is not None}
    return {"python": platform.python_version(), **present}


def all_versions() -> dict[str, str | None]:
    """Versions by name, with None for each package that is not installed."""
    return dict.fromkeys(VERSIONED) | versions()
