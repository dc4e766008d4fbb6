"""The prose of code and docs: docstrings begin with a noun or a verb, and some phrases are banned.

ADRs and raw results keep the words of their time.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CODE = sorted(
    path.relative_to(ROOT)
    for top in ("common", "services", "configs", "mrcdrl", "examples")
    for path in (ROOT / top).rglob("*")
    if path.suffix in {".py", ".cu", ".toml", ".json5"}
)
PROSE = [
    *(Path(name) for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted(
        path.relative_to(ROOT)
        for folder in ("docs", "docs/tutorials")
        for path in (ROOT / folder).glob("*.md")
    ),
]
DANGLING = {"as", "at", "by", "for", "from", "in", "of", "that", "to", "which", "whose", "with"}
BANNED = re.compile(r"(?<!there )\bis no (?!longer\b)|\bfor ever\b|\b(un)?mend(s|ed|ing)?\b", re.I)


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, and of each string that describes a constant or a field."""
    for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                text = statement.value.value
                if isinstance(text, str):
                    yield statement.lineno, text


def dangling(path: Path) -> list[str]:
    return [
        f"{path}:{line}: {text.strip().splitlines()[0]}"
        for line, text in docstrings(path)
        if (re.findall(r"\w+", text) or [""])[0].lower() in DANGLING
    ]


def banned(path: Path) -> list[str]:
    """Banned phrases with what stands around them, wrapped ones included."""
    text = re.sub(r"\s*\n[\s#/*|>]*", " ", (ROOT / path).read_text("utf-8"))
    return [text[max(0, m.start() - 30) : m.end() + 30] for m in BANNED.finditer(text)]


@pytest.mark.parametrize("path", [p for p in CODE if p.suffix == ".py"], ids=Path.as_posix)
def test_docstrings_begin_with_a_noun_or_a_verb(path: Path) -> None:
    assert dangling(path) == []


@pytest.mark.parametrize("path", CODE + PROSE, ids=Path.as_posix)
def test_no_phrase_is_banned(path: Path) -> None:
    assert banned(path) == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a share is no fraction", 1),
        ("it is\n    # no peer", 1),
        ("it waits for ever", 1),
        ("how to mend it", 1),
        ("it is no longer up, is not up; recommended", 0),
    ],
)
def test_the_phrases_are_found(text: str, found: int, tmp_path: Path) -> None:
    (tmp_path / "text.md").write_text(text)
    assert len(banned(tmp_path / "text.md")) == found


def test_a_dangling_docstring_is_found(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text('"""Say what."""\n\n\ndef f():\n    """Of a run."""\n')
    assert dangling(tmp_path / "code.py") == [f"{tmp_path}/code.py:5: Of a run."]
