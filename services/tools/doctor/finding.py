"""What a check found: fine, to be looked at, or failed, and how to mend it."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's."""

    check: str
    verdict: Verdict
    said: str
    mend: str = ""  # what to do; empty where nothing is to be done


def ok(check: str, said: str) -> Finding:
    return Finding(check, "ok", said)


def warning(check: str, said: str, mend: str) -> Finding:
    return Finding(check, "warning", said, mend)


def failed(check: str, said: str, mend: str) -> Finding:
    return Finding(check, "failed", said, mend)
