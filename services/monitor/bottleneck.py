"""Which stage of the ring holds the others up, in words.

Invariants: pure; judged by what replay's limiter held over the last seconds, then by where the
side that is waited for spends its time.
"""

from mrcdrl.services.monitor.state import RunState

HELD = 0.2  # share of the reports from which a limiter counts as holding
ACTOR_STAGES = {
    "inference_share": "collection: actors' inference",
    "arena_share": "collection: actors' arenas",
    "draw_share": "collection: actors' drawing of images",
    "wait_share": "the way from the actors to replay",
}
LEARNER_STAGES = {
    "step_share": "the learner's computation",
    "data_wait_share": "the way from replay to the learner",
    "decode_share": "the learner's decoding of batches",
    "publish_share": "the learner's publishing of weights",
}


def thousands(number: float) -> str:
    """5000 as "5 000", with no-break spaces."""
    return f"{number:,.0f}".replace(",", "\N{NO-BREAK SPACE}")


def limiting_stage(state: RunState) -> str:
    """What a faster run would need first."""
    for role, name in (("replay", "replay"), ("actor", "an actor"), ("learner", "the learner")):
        if not state.alive(role):
            return f"waiting for {name} to be there"
    if state.replay_size < state.config.replay.min_size:
        return (
            f"waiting for replay to fill ({thousands(state.replay_size)} of "
            f"{thousands(state.config.replay.min_size)})"
        )
    insert_held = state.share("replay", "insert_held")
    sample_held = state.share("replay", "sample_held")
    if sample_held > max(HELD, insert_held):
        return _largest(state, "actor", ACTOR_STAGES)
    if insert_held > HELD or state.share("learner", "data_wait_share") < 0.5:
        return _largest(state, "learner", LEARNER_STAGES)
    return _largest(state, "actor", ACTOR_STAGES)


def _largest(state: RunState, role: str, stages: dict[str, str]) -> str:
    return stages[max(stages, key=lambda name: state.share(role, name))]
