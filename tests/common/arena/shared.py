"""Starts, and ways to run a file, that several tests of the arena share."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from mrcdrl.common.arena import Start
from tests.patience import PATIENCE_S

REPOSITORY = Path(__file__).parents[3]
TARGETS = np.array([[175.0, 300.0], [425.0, 300.0]])  # the fixed layout for two
NO_OBSTACLES = np.empty((0, 3))


def start(*robots: tuple[float, float, float]) -> Start:
    return Start(np.array(robots), TARGETS)


def example(name: str, max_lines: int) -> ModuleType:
    """Imports an example and checks that it is short."""
    path = REPOSITORY / "examples" / name
    assert len(path.read_text("utf-8").splitlines()) <= max_lines
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def in_another_process(file: str, expression: str) -> str:
    """Evaluates an expression with the names of a test file; returns its value as a string."""
    code = f"import runpy; print(eval({expression!r}, runpy.run_path({file!r})))"
    command = [sys.executable, "-c", code]
    return subprocess.check_output(command, cwd=REPOSITORY, text=True, timeout=PATIENCE_S).strip()
