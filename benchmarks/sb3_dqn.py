"""Updates per second of stable-baselines3's DQN on our arena, for `benchmarks.system` to compare.

One process alternates between 64 robot steps (8 arenas of two robots) and the updates that the
samples per step call for: 16 of batch 32 at 8 samples per transition, or a batch of 32 every 4
steps. It explores as at the end of a run, so that it nearly always acts by its network. Prints one
line of JSON.
"""

import argparse
import time

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from benchmarks.machine import emit
from mrcdrl.common.arena.envs.sb3 import ArenaVecEnv
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.model.q_network import HIDDEN_UNITS, feature_size

ARENAS, ROBOTS, TRAIN_FREQUENCY, BATCH = 8, 2, 4, 32


class PaperFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """Our network's convolutions, on images that stable-baselines3 has scaled to 0 … 1."""

    def __init__(self, observation_space: object) -> None:
        super().__init__(observation_space, feature_size(60))
        self.layers = nn.Sequential(
            *(nn.Conv2d(4, 32, 5, stride=2), nn.ReLU(), nn.MaxPool2d(2)),
            *(nn.Conv2d(32, 64, 3, stride=2), nn.ReLU()),
            *(nn.Conv2d(64, 64, 3), nn.ReLU(), nn.Flatten()),
        )

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.layers(observations)  # type: ignore[no-any-return]


NETWORKS: dict[str, dict[str, object]] = {
    "sb3": {},
    "paper": {"features_extractor_class": PaperFeatures, "net_arch": [HIDDEN_UNITS]},
}


class Rates(BaseCallback):  # type: ignore[misc]
    """Measures for this many seconds of learning after a warm-up, then ends training."""

    def __init__(self, warm_up_s: float, seconds: float) -> None:
        super().__init__()
        self._warm_up_s, self._seconds = warm_up_s, seconds
        self._learning_s = 0.0
        self._from: tuple[float, int, int] | None = None
        self.updates_per_s = self.robot_steps_per_s = 0.0

    def _on_step(self) -> bool:
        now, updates = time.perf_counter(), self.model._n_updates
        if not updates:
            return True
        self._learning_s = self._learning_s or now
        if self._from is None:
            if now - self._learning_s >= self._warm_up_s:
                self._from = (now, updates, self.num_timesteps)
            return True
        began_s, updates_before, steps_before = self._from
        if (passed_s := now - began_s) < self._seconds:
            return True
        self.updates_per_s = (updates - updates_before) / passed_s
        self.robot_steps_per_s = (self.num_timesteps - steps_before) / passed_s
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--network", choices=NETWORKS, default="paper")
    parser.add_argument("--samples-per-step", type=int, default=8)
    parser.add_argument("--threads", type=int, default=0, help="0: PyTorch's default")
    parser.add_argument("--warm-up", type=float, default=5.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    steps = ARENAS * ROBOTS * TRAIN_FREQUENCY
    model = DQN(
        "CnnPolicy", ArenaVecEnv(ARENAS, ArenaConfig(num_robots=ROBOTS)), seed=0,
        policy_kwargs=NETWORKS[arguments.network],
        batch_size=BATCH, train_freq=TRAIN_FREQUENCY,
        gradient_steps=arguments.samples_per_step * steps // BATCH,
        buffer_size=20_000, learning_starts=2_000, target_update_interval=4_000,
        exploration_initial_eps=0.05, exploration_final_eps=0.05,
    )  # fmt: skip
    rates = Rates(arguments.warm_up, arguments.seconds)
    model.learn(1_000_000_000, callback=rates)
    emit(
        {
            "bench": "sb3_dqn",
            "network": arguments.network,
            "samples_per_step": arguments.samples_per_step,
            "threads": torch.get_num_threads(),
            "updates_per_s": round(rates.updates_per_s, 1),
            "robot_steps_per_s": round(rates.robot_steps_per_s, 1),
        }
    )


if __name__ == "__main__":
    main()
