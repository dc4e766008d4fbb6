"""What the paper prints: its tables, and what it claims of them."""

from dataclasses import dataclass

KINDS = ("dqn", "ddqn", "duel")
NAMES = {"dqn": "DQN", "ddqn": "DDQN", "duel": "Duel"}


@dataclass(frozen=True, slots=True)
class Row:
    """Successes per 100 episodes of one kind."""

    maximum: float
    average: float
    variance: float


TABLE1: dict[int, dict[str, Row]] = {
    2: {"dqn": Row(98, 90.71, 19.37), "ddqn": Row(99, 90.20, 11.38), "duel": Row(100, 94.26, 4.93)},
    3: {"dqn": Row(96, 88.71, 13.19), "ddqn": Row(96, 89.35, 11.44), "duel": Row(96, 89.50, 8.95)},
    4: {"dqn": Row(94, 83.66, 20.89), "ddqn": Row(95, 82.15, 19.48), "duel": Row(93, 83.02, 17.03)},
}
"""Training, by number of robots and kind."""

TABLE2: dict[str, Row] = {
    "dqn": Row(83, 72.09, 33.16),
    "ddqn": Row(94, 86.14, 13.25),
    "duel": Row(97, 92.33, 6.34),
}
"""Test with 4 robots, 1 100 starts, by kind."""

BEST_WEIGHT = 0.7  # p of Fig. 5
SUCCESS_REWARD = 200.0  # of each robot, section 3
