"""The router's access log: what it refuses, and to whom.

Zenoh reports refusals only in a trace of every message that passes; this module reads that trace.

Invariants: the first refusal of a kind is logged at once, repetitions are counted and logged every
few seconds; however much is refused, the log grows slowly and memory is bounded. Zenoh's other
warnings are passed on.
"""

import logging
import os
import re
import sys
import threading
import time
from collections import Counter
from typing import Self, TextIO

import zenoh

_LOG = logging.getLogger("router")
_ACCESS = "zenoh::net::routing::interceptor::access_control"
_FILTER = f"warn,{_ACCESS}=trace"
_REPEAT_S = 10.0  # between lines that count repetitions
_KINDS = 100  # kinds of refusal counted separately in that time
_NAMES = 10_000  # clients remembered
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(
    r"\S+ +(?P<level>[A-Z]+) (?P<thread>.*?ThreadId\(\d+\)) (?P<module>\S+): (?P<text>.*)"
)
_DECISIONS = 9  # that Zenoh caches for a new key: one for each kind of message
_CACHING = re.compile(r"ACL \((?P<flow>\w+)\): caching permissions for `(?P<key>.*)`")
_DECISION = re.compile(
    r"(?P<cached>Using cached result: )?(?P<client>[0-9a-f]+) (?:on (?P<subject>\S+) )?is "
    r"(?P<un>un)?authorized to (?P<action>.*) \((?P<flow>\w+)\) on (?P<key>.*)"
)
_PASSED, _ALLOWED = "Using cached result: ", " is authorized to "
_UNKNOWN = re.compile(r"(?P<client>[0-9a-f]+) did not match any configured ACL subject")
_COMMON_NAME = re.compile(r"CertCommonName\((.*?)\)")
_HANDSHAKE = "zenoh_link_tls::"
_HINT = re.compile(r" Hint: increase the system open file limit\.$")  # wrong when TLS refuses


class AccessLogParser:
    """Finds the refusals in Zenoh's log, line by line."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}  # client's id to its certificate's common name
        # thread to flow, key and decisions to come
        self._caching: dict[str, tuple[str, str, int]] = {}

    def parse(self, line: str) -> str | None:
        """The message to log for a line of Zenoh's log, if any."""
        if _PASSED in line and _ALLOWED in line:
            return None  # nearly all lines: each message that passes writes two
        parts = _LINE.match(_COLOUR.sub("", line))
        if parts is None:
            return line.strip() or None
        text = parts["text"]
        if parts["module"] == _ACCESS:
            return self._refusal(parts["thread"], text)
        if parts["module"].startswith(_HANDSHAKE):
            return f"refused a connection: {_HINT.sub('', text)}"
        return f"{parts['module']}: {text}"

    def _refusal(self, thread: str, text: str) -> str | None:
        """The refusal that a line of the access control reports, if it reports one."""
        if caching := _CACHING.match(text):
            self._caching[thread] = caching["flow"], caching["key"], _DECISIONS
            return None
        if unknown := _UNKNOWN.match(text):
            return f"refused everything from {unknown['client']}: its certificate has no role here"
        decision = _DECISION.match(text)
        if decision is None:
            return None
        name = _COMMON_NAME.search(decision["subject"] or "")
        if name:
            if len(self._names) >= _NAMES:
                self._names.clear()
            self._names[decision["client"]] = name[1]
        flow, key, left = self._caching.pop(thread, ("", "", 0))
        if left and not decision["cached"] and (flow, key) == (decision["flow"], decision["key"]):
            self._caching[thread] = flow, key, left - 1
            return None  # cached for a message yet to come; none was refused
        if not decision["un"] or decision["flow"] != "ingress":
            return None
        who = self._names.get(decision["client"], decision["client"])
        return f"refused {who}: {decision['action']} on {decision['key']}"


class AccessLog:
    """Logs what this process's Zenoh refuses, for as long as the `with` block lasts.

    Captures the process's standard output, to which Zenoh writes. Use it once in a process, before
    the first session.
    """

    def __enter__(self) -> Self:
        reading, writing = os.pipe()
        sys.stdout.flush()
        self._stdout = os.dup(1)
        os.dup2(writing, 1)
        os.close(writing)
        zenoh.init_log_from_env_or(_FILTER)
        self._reader = threading.Thread(
            target=self._follow, args=(os.fdopen(reading, errors="replace"),), name="access-log"
        )
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.dup2(self._stdout, 1)  # ends the pipe, and with it the thread
        os.close(self._stdout)
        self._reader.join()

    def _follow(self, lines: TextIO) -> None:
        parser, repeats = AccessLogParser(), _Repeats()
        with lines:
            for line in lines:
                message = parser.parse(line)
                if message is not None:
                    repeats.add(message)
        repeats.flush()


class _Repeats:
    """Logs a new message at once, and counts its repetitions."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._flushed_s = time.monotonic()

    def add(self, message: str) -> None:
        if time.monotonic() - self._flushed_s > _REPEAT_S:
            self.flush()
        if message not in self._counts and len(self._counts) >= _KINDS:
            message = "refused more requests, of other kinds"
        self._counts[message] += 1
        if self._counts[message] == 1:
            _LOG.warning("%s", message)

    def flush(self) -> None:
        for message, times in self._counts.items():
            if times > 1:
                _LOG.warning("%s (%d more times)", message, times - 1)
        self._counts.clear()
        self._flushed_s = time.monotonic()
