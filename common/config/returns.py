"""The most that an arena's rewards may come to: a bound on what is predicted and what is sent."""

import math

from mrcdrl.common.config.schema import Config

_ON_TARGET = 1.0  # the most that a frame on a target brings, whatever arena.proximity_weight
_COUNTED = 24.0  # the most that a frame of the counting arena brings


def largest_return(config: Config) -> float:
    """A bound on the value of any state, in scaled rewards: all that an episode may bring."""
    agent = config.agent
    frames = min(config.arena.max_frames, 1 / (1 - agent.gamma))
    return agent.reward_scale * _sum_of_rewards(config, frames) + frames * _log_policy(config)


def largest_n_step_return(config: Config) -> float:
    """A bound on a transition's n-step return, in rewards as actors send them."""
    return _sum_of_rewards(config, config.agent.n_step)


def _sum_of_rewards(config: Config, frames: float) -> float:
    """A bound on the absolute sum of a robot's rewards over so many frames of an episode."""
    arena, agent = config.arena, config.agent
    if arena.is_custom:
        return frames * arena.largest_reward
    usual = _COUNTED if arena.kind == "counting" else max(abs(arena.step_reward), _ON_TARGET)
    collisions = min(arena.max_collisions, frames)
    price = abs(arena.collision_reward) * max(factor for _, factor in agent.collision_schedule)
    farthest_px = math.sqrt(2) * arena.size_px
    # Shaping adds up to the difference of two potentials of one sign, however many the frames.
    potential = agent.shaping_per_px * farthest_px
    return abs(arena.success_reward) + collisions * price + frames * usual + potential


def _log_policy(config: Config) -> float:
    """A bound on what the log-policy adds to a frame, in scaled rewards."""
    agent = config.agent
    if not agent.munchausen_alpha:
        return 0.0
    entropy = agent.munchausen_temperature * math.log(max(2, config.arena.action_count))
    return agent.munchausen_alpha * agent.munchausen_clip + entropy
