"""The optional packages: the extra that installs each, and what is said where one is missing."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

from mrcdrl.common.errors import ConfigError

PACKAGES = {  # as they are imported, by the extra that installs them
    "arena": ("numba", "cv2", "pymunk", "scipy"),
    "learn": ("torch", "safetensors", "numba"),
    "report": ("matplotlib", "av", "markdown_it", "tensorboardX"),
    "env": ("pettingzoo", "gymnasium"),
    "certs": ("cryptography",),
    "export": ("onnx", "onnxscript", "onnxruntime"),
    "rerun": ("rerun",),
    "web": ("starlette", "uvicorn", "sse_starlette"),
    "trackio": ("trackio",),
    "wandb": ("wandb",),
}
TRAINING = ("arena", "learn", "report", "web")  # the extras that `all` stands for


@contextmanager
def named_extras() -> Iterator[None]:
    """Turn an import that fails for want of an optional package into one line with its extra.

    Raises ConfigError; other modules that are missing are bugs.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if not any(package in packages for packages in PACKAGES.values()):
            raise
        raise _missing(package) from error


def require(*packages: str) -> None:
    """Raise ConfigError, naming its extra, for the first of these packages that is missing."""
    for package in packages:
        if not is_installed(package):
            raise _missing(package)


def missing_extras() -> dict[str, list[str]]:
    """The extras that are not installed, or not whole, and the packages that each lacks."""
    missing = {
        extra: [package for package in packages if not is_installed(package)]
        for extra, packages in PACKAGES.items()
    }
    return {extra: packages for extra, packages in missing.items() if packages}


def is_installed(package: str) -> bool:
    """Whether a package could be imported; it is not."""
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def _missing(package: str) -> ConfigError:
    extra = next(extra for extra, packages in PACKAGES.items() if package in packages)
    whole = "; 'mrcdrl[all]' has all that training needs" if extra in TRAINING else ""
    return ConfigError(
        f"needs {package}, which is not installed: pip install 'mrcdrl[{extra}]'{whole}"
    )
