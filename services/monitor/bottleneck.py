"""The bottleneck of the ring: the stage that keeps the others waiting.

Invariants: pure; judged by how often replay's limiter throttled over the last seconds, then by
where the side that is waited for spends its time.
"""

from mrcdrl.common.messages.metrics import ActorMetrics, LearnerMetrics, ReplayMetrics
from mrcdrl.services.monitor.phase import progress
from mrcdrl.services.monitor.state import RunState

HELD = 0.2  # share of the reports from which a limiter counts as throttling


def bottleneck(state: RunState) -> str:
    """The stage to speed up first, or what the run waits for."""
    return progress(state).waiting_for or slowest_stage(state)


def slowest_stage(state: RunState) -> str:
    """The stage to speed up first, of a ring that turns."""
    shares = _shares(state)
    return max(shares, key=lambda stage: shares[stage])


def reason(state: RunState) -> str:
    """Why that stage is the bottleneck, in a sentence; empty while the run waits for something."""
    if progress(state).waiting_for:
        return ""
    shares, stage = _shares(state), slowest_stage(state)
    if _collecting_is_late(state):
        return (
            f"The learner could learn from more transitions than actors collect. Of their time, "
            f"actors spend {shares[stage]:.0%} on this stage, more than on any other."
        )
    return (
        f"Actors could collect more transitions than the learner takes. Of its time, the learner "
        f"spends {shares[stage]:.0%} on this stage, more than on any other."
    )


def _collecting_is_late(state: RunState) -> bool:
    """Whether the learner waits for actors, not actors for the learner."""
    replay = state.mean_shares("replay", ReplayMetrics)
    learner = state.mean_shares("learner", LearnerMetrics)
    learner_is_late = replay.insert_held > HELD or learner.data_wait_share < 0.5
    return replay.sample_held > max(HELD, replay.insert_held) or not learner_is_late


def _shares(state: RunState) -> dict[str, float]:
    """Shares of time of the stages on the side that is waited for."""
    if _collecting_is_late(state):
        actor = state.mean_shares("actor", ActorMetrics)
        return {
            "collection: actor inference": actor.inference_share,
            "collection: arenas": actor.arena_share,
            "collection: rendering": actor.draw_share,
            "actors → replay transfer": actor.wait_share,
        }
    learner = state.mean_shares("learner", LearnerMetrics)
    return {
        "learner computation": learner.step_share,
        "replay → learner transfer": learner.data_wait_share,
        "learner decoding of batches": learner.decode_share,
        "learner publishing of weights": learner.publish_share,
    }
