"""The public API: every name of `mrcdrl.__all__`, each imported only when it is used."""

import ast
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

import mrcdrl
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(set(mrcdrl.__all__) - {"__version__"})


def typed_imports() -> dict[str, str]:
    """Names that type checkers see, with the module of each."""
    tree = ast.parse((ROOT / "mrcdrl/__init__.py").read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.name: node.module or ""
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_name_brings_its_module_on_first_use(name: str) -> None:
    """In a fresh interpreter; the module and the object are those that type checkers see."""
    module = typed_imports()[name]
    code = f"""
import sys, mrcdrl
own = sorted(m for m in sys.modules if m.startswith("mrcdrl"))
assert own == ["mrcdrl"], own
value = mrcdrl.{name}
assert value is sys.modules["{module}"].{name}
assert vars(mrcdrl)["{name}"] is value
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=PATIENCE_S)


def test_type_checkers_see_every_name() -> None:
    assert sorted(typed_imports()) == NAMES
    assert (ROOT / "mrcdrl/py.typed").is_file()


def test_the_version_is_that_of_the_distribution() -> None:
    assert mrcdrl.__version__ == importlib.metadata.version("mrcdrl")


def test_every_name_is_listed_and_described() -> None:
    assert set(mrcdrl.__all__) <= set(dir(mrcdrl))
    assert mrcdrl.__doc__ is not None
    assert [name for name in NAMES if f"`{name}`" not in mrcdrl.__doc__] == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Nosuch'"):
        mrcdrl.Nosuch  # noqa: B018
