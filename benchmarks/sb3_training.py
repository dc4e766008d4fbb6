"""stable-baselines3's DQN, trained with two robots until 90 starts of 100 of the test succeed.

    python -m benchmarks.sb3_training --minutes 90 --threads 1 >> RESULTS.jsonl

It is set up like our preset quick where it can be: the paper's convolutions, 3-step returns, Huber
loss, reward scale, learning rate and its schedule, Adam's epsilon, target period, exploration by
updates, and a batch of 32 every 4 robot steps. It has no double targets, duel network or
symmetries. Prints one line of JSON with the successes of the last 100 training episodes every 1000
updates, and one for each test; the first test comes when half of those episodes succeeded.
"""

import argparse
import contextlib
import time
from collections import deque

import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from benchmarks.machine import emit
from benchmarks.sb3_dqn import ARENAS, BATCH, NETWORKS, ROBOTS, TRAIN_FREQUENCY
from mrcdrl.common.arena import test_starts
from mrcdrl.common.arena.envs.sb3 import ArenaVecEnv
from mrcdrl.common.arena.images.codec import make_codec
from mrcdrl.common.config import ArenaConfig, Config, load_config
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.messages.trajectory import BoolArray, Float32Array, Outcome, UInt8Array
from mrcdrl.common.model.policy import Selection
from mrcdrl.services.evaluator.trial import EPISODES_PER_BLOCK, PolicyPlayer, play

_REPORT_UPDATES = 1_000
_TEST_UPDATES = 2_500
_TESTED_FROM = 50  # successes in the last 100 training episodes
_BUFFER = 200_000


class ScaledRewards(VecEnvWrapper):  # type: ignore[misc]
    """Scales rewards as our learner does."""

    def __init__(self, arenas: ArenaVecEnv, scale: float) -> None:
        super().__init__(arenas)
        self._scale = scale

    def reset(self) -> UInt8Array:
        return self.venv.reset()  # type: ignore[no-any-return]

    def step_wait(self) -> tuple[UInt8Array, Float32Array, BoolArray, list[dict[str, object]]]:
        states, rewards, ends, infos = self.venv.step_wait()
        return states, rewards * self._scale, ends, infos


class Greedy:
    """Acts by the model's values as our evaluator acts by ours."""

    def __init__(self, model: DQN) -> None:
        self._model = model

    def select_actions(
        self, observations: UInt8Array, epsilon: float, rng: np.random.Generator
    ) -> Selection:
        with torch.inference_mode():
            values = self._model.q_net(torch.from_numpy(observations)).numpy()
        greedy = values.argmax(axis=1).astype(np.uint8)
        uniform = rng.integers(values.shape[1], size=len(values), dtype=np.uint8)
        actions = np.where(rng.random(len(values)) < epsilon, uniform, greedy)
        return Selection(actions=actions, q_values=values, greedy_q=values.max(axis=1))


class Evaluation(BaseCallback):  # type: ignore[misc]
    """Reports and tests during training; ends it at the wanted successes or out of time."""

    def __init__(self, arena: ArenaConfig, wanted: int, seconds: float) -> None:
        super().__init__()
        self._arena, self._wanted, self._seconds = arena, wanted, seconds
        self._outcomes: deque[str] = deque(maxlen=EPISODES_PER_BLOCK)
        self._began_s = time.perf_counter()
        self._testing_s = 0.0
        self._reported = self._tested = 0

    def _on_step(self) -> bool:
        ended = np.flatnonzero(self.locals["dones"])[::ROBOTS]  # one robot of each arena
        self._outcomes.extend(self.locals["infos"][i]["outcome"] for i in ended)
        return True

    def _on_rollout_end(self) -> None:
        updates = self.model._n_updates
        if updates - self._reported >= _REPORT_UPDATES:
            self._reported = updates
            self._report()

    def on_rollout_start(self) -> None:
        super().on_rollout_start()
        updates = self.model._n_updates
        if updates - self._tested >= _TEST_UPDATES and self._successes >= _TESTED_FROM:
            self._tested = updates
            if self._test() >= self._wanted:
                raise StopIteration
        if self._learning_s >= self._seconds:
            raise StopIteration

    @property
    def _successes(self) -> int:
        return self._outcomes.count(Outcome.SUCCESS.value)

    @property
    def _learning_s(self) -> float:
        return time.perf_counter() - self._began_s - self._testing_s

    def _report(self, **more: object) -> None:
        emit(
            {
                "bench": "sb3_training",
                "updates": self.model._n_updates,
                "robot_steps": self.num_timesteps,
                "minutes": round(self._learning_s / 60, 2),
                "cpu_minutes": round(time.process_time() / 60, 2),
                "training_successes_of_100": self._successes,
                "epsilon": round(self.model.exploration_rate, 3),
                **more,
            }
        )

    def _test(self) -> int:
        """Successes in the paper's test; its time does not count as training time."""
        began_s = time.perf_counter()
        config = Config(arena=self._arena)
        player = PolicyPlayer(
            self._arena, make_codec(self._arena), Greedy(self.model),  # type: ignore[arg-type]
            config.evaluator.epsilon, np.random.default_rng(0),
        )  # fmt: skip
        starts = test_starts(self._arena, EPISODES_PER_BLOCK, 0)
        results = play(self._arena, starts, player) or []
        successes = [r.outcome for r in results].count(Outcome.SUCCESS)
        self._testing_s += time.perf_counter() - began_s
        self._report(test_successes_of_100=successes)
        return successes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=90)
    parser.add_argument("--wanted", type=int, default=90, help="successes of 100")
    parser.add_argument("--samples-per-step", type=int, default=8)
    parser.add_argument("--threads", type=int, default=0, help="0: PyTorch's default")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    quick = load_config("quick", environ={})
    agent, steps = quick.agent, ARENAS * ROBOTS * TRAIN_FREQUENCY
    per_step = arguments.samples_per_step / BATCH  # updates
    arenas = ScaledRewards(ArenaVecEnv(ARENAS, quick.arena), agent.reward_scale)
    model = DQN(
        "CnnPolicy", arenas, seed=arguments.seed,
        policy_kwargs={
            **NETWORKS["paper"], "optimizer_kwargs": {"eps": agent.optimizer_epsilon},
        },
        learning_rate=agent.learning_rate,
        gamma=agent.gamma, n_steps=agent.n_step, batch_size=BATCH, train_freq=TRAIN_FREQUENCY,
        gradient_steps=int(per_step * steps), buffer_size=_BUFFER,
        learning_starts=quick.replay.min_size,
        target_update_interval=int(agent.target_period / per_step),
    )  # fmt: skip
    model.lr_schedule = lambda _: (
        agent.learning_rate * value_at(agent.learning_rate_schedule, model._n_updates)
    )
    model.exploration_schedule = lambda _: value_at(quick.exploration.schedule, model._n_updates)
    evaluation = Evaluation(quick.arena, arguments.wanted, arguments.minutes * 60)
    with contextlib.suppress(StopIteration):
        model.learn(1_000_000_000, callback=evaluation)


if __name__ == "__main__":
    main()
