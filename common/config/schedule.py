"""Schedules: settings that change with the learner's steps. Pure."""

from collections.abc import Sequence

import numpy as np


def value_at(points: Sequence[tuple[float, float]], learner_step: int) -> float:
    """The value at a learner step: linear between the points, constant before and after them."""
    steps = [step for step, _ in points]
    values = [value for _, value in points]
    return float(np.interp(learner_step, steps, values))
