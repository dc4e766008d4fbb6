"""What a router refuses, in its own log: Zenoh says so only among everything that passes.

Invariants: the first refusal of a kind is logged at once, more of it once in a while and counted;
however much is refused, the log grows slowly and nothing here grows without bound. Everything
else that Zenoh warns of is handed on.
"""

import logging
import os
import re
import sys
import threading
import time
from collections import Counter
from types import TracebackType
from typing import Self, TextIO

import zenoh

_LOG = logging.getLogger("router")
_ACCESS = "zenoh::net::routing::interceptor::access_control"
_FILTER = f"warn,{_ACCESS}=trace"
_AGAIN_S = 10.0  # between lines that count repetitions
_KINDS = 100  # of refusals told apart in that time
_NAMES = 10_000  # of clients remembered
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(
    r"\S+ +(?P<level>[A-Z]+) (?P<thread>.*?ThreadId\(\d+\)) (?P<module>\S+): (?P<text>.*)"
)
_JUDGEMENTS = 9  # made ahead for a key: one for each kind of message
_CACHING = re.compile(r"ACL \((?P<flow>\w+)\): caching permissions for `(?P<key>.*)`")
_JUDGED = re.compile(
    r"(?P<cached>Using cached result: )?(?P<client>[0-9a-f]+) (?:on (?P<subject>\S+) )?is "
    r"(?P<un>un)?authorized to (?P<action>.*) \((?P<flow>\w+)\) on (?P<key>.*)"
)
_PASSED, _ALLOWED = "Using cached result: ", " is authorized to "
_UNKNOWN = re.compile(r"(?P<client>[0-9a-f]+) did not match any configured ACL subject")
_COMMON_NAME = re.compile(r"CertCommonName\((.*?)\)")
_HANDSHAKE = "zenoh_link_tls::"
_HINT = re.compile(r" Hint: increase the system open file limit\.$")  # wrong, where TLS refuses


class Judge:
    """Tells, line by line of Zenoh's log, what was refused."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}  # client's id to its certificate's common name
        self._ahead: dict[str, tuple[str, str, int]] = {}  # thread to flow, key, judgements to come

    def read(self, line: str) -> str | None:
        """What a line says, if somebody has to know it."""
        if _PASSED in line and _ALLOWED in line:
            return None  # nearly all lines: a message that passes is two
        parts = _LINE.match(_COLOUR.sub("", line))
        if parts is None:
            return line.strip() or None
        text = parts["text"]
        if parts["module"] == _ACCESS:
            return self._judged(parts["thread"], text)
        if parts["module"].startswith(_HANDSHAKE):
            return f"refused a connection: {_HINT.sub('', text)}"
        return f"{parts['module']}: {text}"

    def _judged(self, thread: str, text: str) -> str | None:
        if caching := _CACHING.match(text):
            self._ahead[thread] = caching["flow"], caching["key"], _JUDGEMENTS
            return None
        if unknown := _UNKNOWN.match(text):
            return f"refused everything from {unknown['client']}: its certificate has no role here"
        judged = _JUDGED.match(text)
        if judged is None:
            return None
        name = _COMMON_NAME.search(judged["subject"] or "")
        if name:
            if len(self._names) >= _NAMES:
                self._names.clear()
            self._names[judged["client"]] = name[1]
        flow, key, left = self._ahead.pop(thread, ("", "", 0))
        if left and not judged["cached"] and (flow, key) == (judged["flow"], judged["key"]):
            self._ahead[thread] = flow, key, left - 1
            return None  # what would be, if it were asked for
        if not judged["un"] or judged["flow"] != "ingress":
            return None
        who = self._names.get(judged["client"], judged["client"])
        return f"refused {who}: {judged['action']} on {judged['key']}"


class Refusals:
    """Reads Zenoh's log of this process as long as the `with` block lasts.

    Takes the process's standard output, to which Zenoh writes, for itself; once a process, before
    its first session.
    """

    def __enter__(self) -> Self:
        reading, writing = os.pipe()
        sys.stdout.flush()
        self._stdout = os.dup(1)
        os.dup2(writing, 1)
        os.close(writing)
        zenoh.init_log_from_env_or(_FILTER)
        self._reader = threading.Thread(
            target=self._follow, args=(os.fdopen(reading, errors="replace"),), name="refusals"
        )
        self._reader.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.dup2(self._stdout, 1)  # which ends the pipe, and with it the thread
        os.close(self._stdout)
        self._reader.join()

    def _follow(self, lines: TextIO) -> None:
        judge, counted = Judge(), _Counted()
        with lines:
            for line in lines:
                said = judge.read(line)
                if said is not None:
                    counted.add(said)
        counted.tell()


class _Counted:
    """Logs what is new, and counts the rest."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._told_s = time.monotonic()

    def add(self, said: str) -> None:
        if time.monotonic() - self._told_s > _AGAIN_S:
            self.tell()
        if said not in self._counts and len(self._counts) >= _KINDS:
            said = "refused more, of other kinds"
        self._counts[said] += 1
        if self._counts[said] == 1:
            _LOG.warning("%s", said)

    def tell(self) -> None:
        for said, times in self._counts.items():
            if times > 1:
                _LOG.warning("%s (%d times more)", said, times - 1)
        self._counts.clear()
        self._told_s = time.monotonic()
