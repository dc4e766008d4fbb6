"""The most that an arena's rewards may come to: a bound on what is predicted and what is sent."""

from mrcdrl.common.config.schema import ArenaConfig, Config

_ON_TARGET = 1.0  # the most that a frame on a target brings, whatever arena.proximity_weight
_COUNTED = 24.0  # the most that a frame of the counting arena brings


def largest_return(config: Config) -> float:
    """A bound on the value of any state, in scaled rewards: all that an episode may bring."""
    frames = min(config.arena.max_frames, 1 / (1 - config.agent.gamma))
    return config.agent.reward_scale * _sum_of_rewards(config.arena, frames)


def largest_n_step_return(config: Config) -> float:
    """A bound on a transition's n-step return, in rewards as the arena gives them."""
    return _sum_of_rewards(config.arena, config.agent.n_step)


def _sum_of_rewards(arena: ArenaConfig, frames: float) -> float:
    """A bound on the absolute sum of a robot's rewards over so many frames of an episode."""
    usual = _COUNTED if arena.kind == "counting" else max(abs(arena.step_reward), _ON_TARGET)
    collisions = min(arena.max_collisions, frames)
    return abs(arena.success_reward) + collisions * abs(arena.collision_reward) + frames * usual
