"""Join a run that is up on this machine, and play its arena with the newest weights.

Run `python examples/live_policy.py four` beside `mrcdrl train --name four`.
"""

import sys
from pathlib import Path

import numpy as np

from mrcdrl.common.arena import ArenaBatch, make_codec
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.common.sync.live_policy import LivePolicy


def main(run_dir: Path, episodes: int = 20) -> None:
    endpoint = (run_dir / "endpoint").read_text()
    with LivePolicy(run_dir.name, endpoint, epsilon=0.01) as policy:
        arena = ArenaBatch(policy.config.arena, [np.random.default_rng()])
        codec = make_codec(policy.config.arena)
        successes = 0
        for episode in range(1, episodes + 1):
            policy.begin()
            step = arena.reset(0)
            while not step.last:
                actions = policy.act(codec.decode(step.records))
                step = arena.step(actions[np.newaxis])[0]
            successes += step.outcome is Outcome.SUCCESS
            print(f"{successes} of {episode}, version {policy.version}")


if __name__ == "__main__":
    main(Path("runs") / sys.argv[1])
