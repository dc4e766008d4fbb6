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
    return progress(state).waiting_for or max(shares, key=lambda stage: shares[stage])
