"""Follows a run: feeds its messages to the state, the recorder and the stopping rule."""

import logging
import threading
import time
from collections.abc import Callable
from itertools import chain
from typing import TypeVar

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.checks import MAX_REPORT_BYTES
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Stats
from mrcdrl.common.messages.wire import decode_published
from mrcdrl.common.runtime.names import is_name
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys, role_and_worker
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.monitor.watching import Watching

_LOG = logging.getLogger("train")
M = TypeVar("M", Stats, EpisodeSummary, Evaluation)


class Follower:
    """Subscribes to all statistics, episodes, evaluations and presence of a run.

    recorder: writes them down, and knows the run's past; None to keep no record. lasted_s: seconds
    that the run had lasted, where there is no recorder to know it.

    A message counts if its sender holds, or has held, a liveliness token, as every process of a run
    does. One that cannot be folded in is left out, which is said once.

    Whoever reads the state in another thread holds `lock` meanwhile.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        state: RunState,
        recorder: Recorder | None,
        rule: StoppingRule,
        lasted_s: float = 0.0,
    ) -> None:
        self._stats, self._episodes, self._evaluations = (
            session.queue_subscriber(key, max_message_bytes=MAX_REPORT_BYTES)
            for key in (keys.every_stats, keys.every_episode, keys.every_evaluation)
        )
        self._presence = session.presence(keys.everyone())
        self._state = state
        self._recorder = recorder
        self._rule = rule
        self.lock = threading.Lock()
        self._watching = Watching()
        self._refused = 0
        if recorder:
            lasted_s = state.resumed_at_s = recorder.restore(state, rule)
        self._lasted_s = lasted_s
        self._started_s = time.monotonic()
        self._record_due_s = 0.0

    @property
    def now(self) -> float:
        """Seconds the run has lasted, over all resumptions."""
        return self._lasted_s + self.lived_s

    @property
    def lived_s(self) -> float:
        """Seconds since this start."""
        return time.monotonic() - self._started_s

    def listen(self, timeout_s: float) -> bool:
        """Take in all that has arrived, waiting up to `timeout_s` for statistics; whether any
        arrived."""
        first = self._stats.take(timeout_s)
        with self.lock:
            self._fold(first)
        if self._recorder and self.lived_s >= self._record_due_s:
            self._record_due_s = self.lived_s + 1.0
            self._recorder.record_metrics(self._state, self.now)
        return first is not None

    def _fold(self, first: tuple[str, bytes] | None) -> None:
        """Take in these statistics, and all else that has arrived."""
        with self._watching("following who is up"):
            for key, alive in self._presence.changes():
                role, worker = role_and_worker(key)
                if is_name(role) and is_name(worker):
                    self._state.observe_presence(role, worker, alive)
        for item in chain([first] if first else [], self._stats.drain()):
            self._take(Stats, item, lambda s: self._state.observe_stats(s, self.now))
        for item in self._episodes.drain():
            self._take(EpisodeSummary, item, self._observe_episode)
        for item in self._evaluations.drain():
            self._take(Evaluation, item, self._observe_evaluation)

    def stop_reason(self, *, learner_ended: bool) -> str | None:
        """Why the run should end now, or None; minutes count from this start.

        learner_ended: whether the learner's process has. Steps that are only told end no run.
        """
        state = self._state
        steps = state.learner_steps if learner_ended else 0
        return self._rule.reason(steps, self.lived_s / 60, state.published)

    def _observe_episode(self, episode: EpisodeSummary) -> None:
        self._state.observe_episode(episode)
        self._rule.observe_episode(episode)
        if self._recorder:
            self._recorder.record_episode(episode, self._state, self.now)

    def _observe_evaluation(self, evaluation: Evaluation) -> None:
        record = self._state.observe_evaluation(evaluation, self.now)
        self._rule.observe_evaluation(evaluation)
        if self._recorder:
            self._recorder.record_evaluation(record)

    def _check_sender(self, message: Stats | EpisodeSummary | Evaluation) -> None:
        """Raise WireError if nobody who is, or was, up goes by the sender's name."""
        match message:
            case Stats(role, worker):
                sender = (role, worker)
            case EpisodeSummary():
                sender = ("actor", message.actor)
            case Evaluation():
                sender = ("evaluator", message.worker)
        if not self._state.knows(*sender):
            raise WireError(f"{' '.join(sender)} holds no liveliness token")

    def _take(self, cls: type[M], item: tuple[str, bytes], observe: Callable[[M], None]) -> None:
        try:
            message = decode_published(cls, *item)
            self._check_sender(message)
        except WireError as error:
            self._refused += 1
            if is_logged(self._refused):
                _LOG.warning(
                    "%s message refused, %d so far: %s", cls.__name__, self._refused, error
                )
            return
        with self._watching(f"following {cls.__name__} messages"):
            observe(message)
