"""The bottleneck of the ring: the stage that keeps the others waiting.

Invariants: pure; judged by how often replay's limiter throttled over the last seconds, then by
where the side that is waited for spends its time.
"""

from mrcdrl.common.messages.metrics import ActorMetrics, LearnerMetrics, ReplayMetrics
from mrcdrl.services.monitor.state import RunState

HELD = 0.2  # share of the reports from which a limiter counts as throttling


def thousands(number: float) -> str:
    """5000 as "5 000", with no-break spaces."""
    return f"{number:,.0f}".replace(",", "\N{NO-BREAK SPACE}")


def waiting_for(state: RunState) -> str | None:
    """What has to happen before the ring can turn; None if it turns."""
    for role, name in (("replay", "replay"), ("actor", "an actor"), ("learner", "the learner")):
        if not state.alive(role):
            return f"waiting for {name} to start"
    size, needed = state.replay_size, state.config.replay.min_size
    if size < needed:
        return f"waiting for replay to fill ({thousands(size)} of {thousands(needed)})"
    return None


def bottleneck(state: RunState) -> str:
    """The stage to speed up first, or what the run waits for."""
    replay = state.mean_shares("replay", ReplayMetrics)
    learner = state.mean_shares("learner", LearnerMetrics)
    learner_is_late = replay.insert_held > HELD or learner.data_wait_share < 0.5
    if replay.sample_held > max(HELD, replay.insert_held) or not learner_is_late:
        actor = state.mean_shares("actor", ActorMetrics)
        shares = {
            "collection: actor inference": actor.inference_share,
            "collection: arenas": actor.arena_share,
            "collection: rendering": actor.draw_share,
            "actors → replay transfer": actor.wait_share,
        }
    else:
        shares = {
            "learner computation": learner.step_share,
            "replay → learner transfer": learner.data_wait_share,
            "learner decoding of batches": learner.decode_share,
            "learner publishing of weights": learner.publish_share,
        }
    return waiting_for(state) or max(shares, key=lambda stage: shares[stage])


def bottleneck_line(state: RunState) -> str:
    """The bottleneck named as such, or what the run waits for."""
    return waiting_for(state) or f"bottleneck: {bottleneck(state)}"
