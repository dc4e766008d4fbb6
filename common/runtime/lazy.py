"""Names of a package that are imported on first use, so that nobody loads what only others need."""

import importlib
import sys
from collections.abc import Mapping


def imported(package: str, modules: Mapping[str, str], name: str) -> object:
    """A name of a package, for its `__getattr__`; the package keeps it.

    modules: by name, where it is from, below the package. Raises AttributeError for another name.
    """
    if name not in modules:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    value: object = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
    setattr(sys.modules[package], name, value)
    return value
