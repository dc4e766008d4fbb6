"""The result of a check: ok, a warning or failed, and how to fix it."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    check: str
    verdict: Verdict
    said: str
    fix: str = ""  # what to do; empty if there is nothing to do


def ok(check: str, said: str) -> Finding:
    return Finding(check, "ok", said)


def warning(check: str, said: str, fix: str) -> Finding:
    return Finding(check, "warning", said, fix)


def failed(check: str, said: str, fix: str) -> Finding:
    return Finding(check, "failed", said, fix)
