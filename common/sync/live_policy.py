"""Acting with the newest weights of a run that is up, from outside the run.

    with LivePolicy.of_run("four") as policy:
        actions = policy.act(images)  # uint8 [N, V, V] in, uint8 [N] out

Invariants: weights only ever get newer; weights that are torn, altered or of another network are
counted and dropped; only `act` adopts, so that one version chooses all actions of a call. For one
thread. It asks for the configuration, and for weights: the first, or after a long silence.
"""

import contextlib
import time
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mrcdrl.common.config import load_transport
from mrcdrl.common.errors import DeadlineError
from mrcdrl.common.messages.trajectory import UInt8Array, Weights
from mrcdrl.common.model.policy import FrameStack, make_policy
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import run_path
from mrcdrl.common.sync.joining import Joining, fetch_config, recorded_endpoint
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session


class LivePolicy(Closing):
    """Follows a run's weights and acts with them; use it in a `with` block.

    run: the run's name. endpoint: its router or replay service, such as tcp/HOST:7447. epsilon:
    probability of a random action. seed: of these actions. timeout_s: for each of the endpoint, the
    configuration and the first weights; DeadlineError or EndpointError says which did not come.
    """

    def __init__(
        self,
        run: str,
        endpoint: str,
        *,
        epsilon: float = 0.0,
        seed: int = 0,
        timeout_s: float = 30.0,
    ) -> None:
        self._epsilon = epsilon
        self._rng = np.random.default_rng(seed)
        self._fresh = np.ones(0, np.bool_)
        self._adopted_s = time.monotonic()
        transport = load_transport({}).model_copy(update={"connect": (endpoint,), "listen": ()})
        stop = StopSignal()
        joining = Joining(run, "live", Path(), transport, {})
        with contextlib.ExitStack() as opened:
            session = opened.enter_context(Session(transport, open_timeout_s=timeout_s))
            self.config = fetch_config(session, joining, stop, timeout_s)
            self._policy = make_policy(self.config)
            averages = self.config.learner.average_apart
            self._reader = WeightsReader(session, joining.keys, self._adopt, averages=averages)
            if self._reader.wait(stop, timeout_s) is None:
                raise DeadlineError(
                    f"no weights of run {run!r} came within {timeout_s:g} s; is its learner up?"
                )
            self._opened = opened.pop_all()

    @classmethod
    def of_run(
        cls,
        run: str | Path,
        *,
        epsilon: float = 0.0,
        seed: int = 0,
        timeout_s: float = 30.0,
    ) -> Self:
        """Follow a run that `mrcdrl train` has started on this machine.

        run: its name, its path, or `latest`; the other arguments are those of the class. Raises
        UnreachableError if the run is not up or there is none of that name.
        """
        path = run_path(str(run))
        endpoint = recorded_endpoint(path, "LivePolicy its endpoint")
        return cls(path.name, endpoint, epsilon=epsilon, seed=seed, timeout_s=timeout_s)

    def close(self) -> None:
        """Leave the run; harmless if repeated."""
        self._opened.close()

    def __repr__(self) -> str:
        return f"LivePolicy(version={self.version}, staleness_s={self.staleness_s:.1f})"

    @property
    def version(self) -> int:
        """Version of the weights in use."""
        return self._policy.weights_version

    @property
    def staleness_s(self) -> float:
        """Seconds since these weights were adopted."""
        return time.monotonic() - self._adopted_s

    @property
    def refused(self) -> int:
        """Number of weights that were torn, altered, too large or of another network."""
        return self._reader.refused

    def begin(self, robots: NDArray[np.integer] | slice = slice(None)) -> None:
        """Begin an episode of these robots: their next images start new stacks."""
        self._fresh[robots] = True

    def act(self, observations: UInt8Array) -> UInt8Array:
        """Choose actions uint8 [N] with the newest weights: 0 left, 1 straight, 2 right.

        observations: the N robots' images, uint8 [N, V, V], which are stacked on their earlier
        ones; or whole states, uint8 [N, S, V, V]. Another N starts new stacks for all robots.
        """
        self._reader.latest()
        states = observations if observations.ndim == 4 else self._stacked(observations)
        return self._policy.select_actions(states, self._epsilon, self._rng).actions

    def _adopt(self, weights: Weights) -> None:
        self._policy.adopt(weights)
        self._adopted_s = time.monotonic()

    def _stacked(self, images: UInt8Array) -> UInt8Array:
        """States uint8 [N, S, V, V]; an episode's first image also fills the frames before it."""
        if len(images) != len(self._fresh):
            arena = self.config.arena
            self._frames = FrameStack(len(images), arena.stack, arena.view_px)
            self._fresh = np.ones(len(images), np.bool_)
        follow, begin = np.flatnonzero(~self._fresh), np.flatnonzero(self._fresh)
        self._frames.push(images[follow], follow)
        self._frames.reset(begin, images[begin])
        self._fresh[:] = False
        return self._frames.stacks
