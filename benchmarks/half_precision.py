"""What half precision of published weights costs: actions that differ, and success in the test.

    python -m benchmarks.half_precision RUN [--episodes 200]

Plays the paper's test with the best weights of a run, in float32. In each state it also looks at
what weights sent as bfloat16 and as float16 would have done there. Then it plays the same starts
with each. All networks compute as actors do. Prints one line of JSON for each precision.
"""

import argparse
from collections import Counter

import numpy as np
import torch

from benchmarks.machine import emit
from mrcdrl.common.arena import make_codec, test_starts
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import Float32Array, UInt8Array, Weights
from mrcdrl.common.model.policy import Policy, make_policy
from mrcdrl.common.model.saved_policy import config_beside, read_saved, weights_path
from mrcdrl.common.model.weights_io import SENT_AS, network_from_bytes, weights_to_bytes
from mrcdrl.common.runtime.runs import find_weights
from mrcdrl.services.evaluator.trial import PolicyPlayer, play

_SEED = 77


class Comparing(Policy):
    """A policy that counts in how many states others would have acted otherwise."""

    def __init__(self, policy: Policy, others: dict[str, Policy]) -> None:
        super().__init__(policy.network)
        self._others = others
        self.states = 0
        self.differ: Counter[str] = Counter()

    def q_values(self, observations: UInt8Array) -> Float32Array:
        """The policy's own values."""
        values = super().q_values(observations)
        self.states += len(values)
        for name, other in self._others.items():
            greedy = other.q_values(observations).argmax(axis=1)
            self.differ[name] += int((greedy != values.argmax(axis=1)).sum())
        return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run")
    parser.add_argument("--episodes", type=int, default=200)
    arguments = parser.parse_args()
    path = weights_path(find_weights(arguments.run))
    config, saved = load_config(config_beside(path), environ={}), read_saved(path)
    policies = {name: sent_as(config, saved, dtype) for name, dtype in SENT_AS.items()}
    comparing = Comparing(policies["float32"], policies)
    success(config, comparing, arguments.episodes)
    for name, policy in policies.items():
        emit(
            {
                "bench": "half_precision",
                "weights": path.name,
                "learner_step": saved.learner_step,
                "robots": config.arena.num_robots,
                "sent_as": name,
                "computed_as": config.learner.precision,
                "states": comparing.states,
                "actions_that_differ": comparing.differ[name] / comparing.states,
                "episodes": arguments.episodes,
                "success": success(config, policy, arguments.episodes),
            }
        )


def sent_as(config: Config, saved: Weights, dtype: torch.dtype) -> Policy:
    """An actor's policy after the weights were sent in this precision."""
    policy = make_policy(config, averages=False)
    payload = weights_to_bytes(network_from_bytes(saved.payload), dtype)
    policy.adopt(Weights.of(1, 1, saved.learner_step, payload))
    return policy


def success(config: Config, policy: Policy, episodes: int) -> float:
    """The share of the test's starts that succeed without exploration."""
    rng = np.random.default_rng(_SEED)
    player = PolicyPlayer(config.arena, make_codec(config.arena), policy, 0.0, rng)
    results = play(config.arena, test_starts(config.arena, episodes, _SEED), player) or []
    return float(np.mean([result.outcome.value == "success" for result in results]))


if __name__ == "__main__":
    main()
