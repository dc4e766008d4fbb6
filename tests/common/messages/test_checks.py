"""What no process of ours sends is refused with its reason, and shown as printable text."""

import dataclasses
from typing import Any

import msgpack
import pytest

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.checks import MAX_METRICS, MAX_TEXT, MAX_TEXTS
from mrcdrl.common.messages.metrics import EvaluatorMetrics, LearnerMetrics, kinds
from mrcdrl.common.messages.trajectory import (
    EpisodeSummary,
    Evaluation,
    InsertReply,
    Outcome,
    PrioritiesReply,
    SampleRequest,
    Stats,
    Weights,
)
from mrcdrl.common.messages.wire import decode, decode_published, encode
from mrcdrl.common.runtime.names import MAX_TEXT as MOST_SHOWN
from mrcdrl.common.runtime.names import is_name, printable
from tests.common.messages.test_wire import CHUNK, SAMPLES, changed, floats

EVALUATION = Evaluation("e", 7, 3, 100, 2, 10, 0.5, 0.25, 0.25, (0.2, 0.8), 5, 5, 0, 9, 1.5, 0, 1.0)
EPISODE = EpisodeSummary("a", 0, 1, Outcome.SUCCESS, 9, 1.5, 0, 0.1, 3, 2.5, 2)
LEARNER = Stats("learner", "0", {"learner_steps": 5.0, "loss": 0.5}, {"python": "3.12.1"})
WEIGHTS = Weights.of(1, 2, 20, b"payload")
SOUND = (CHUNK, SAMPLES, EVALUATION, EPISODE, LEARNER, WEIGHTS)
ESCAPE = "\x1b[31m"
NAN, INF = float("nan"), float("inf")

ODD: list[tuple[Any, dict[str, Any], str]] = [
    *[
        (EVALUATION, {name: value}, f"{name} .* is outside 0 ... 1")
        for name in ("success_rate", "collision_rate", "timeout_rate")
        for value in (-0.1, 1.1, NAN, INF)
    ],
    (EVALUATION, {"success_rate": 1.0}, "sum to 1.5, not 1"),
    *[
        (EVALUATION, {"success_interval": value}, "does not rise within 0 ... 1")
        for value in ([0.8, 0.2], [-0.1, 0.5], [0.5, 1.1], [NAN, 1.0], [0.0, INF])
    ],
    *[(EVALUATION, {"num_robots": value}, "outside 1 ... 10") for value in (0, -1, 11, 99)],
    (EVALUATION, {"episodes": 0}, "episodes 0 is outside 1"),
    (EVALUATION, {"weights_version": -1}, "weights_version -1 is outside 0"),
    (EVALUATION, {"learner_step": 2**60}, "learner_step"),
    (EVALUATION, {"mean_per_100": 101.0}, "outside 0 ... 100"),
    (EVALUATION, {"variance_per_100": NAN}, "variance_per_100 nan"),
    (EVALUATION, {"mean_frames": -1.0}, "mean_frames -1"),
    (EVALUATION, {"mean_score": 1e300}, "mean_score"),
    (EVALUATION, {"wall_s": NAN}, "wall_s nan"),
    (EVALUATION, {"worker": ESCAPE}, "worker is not a name"),
    (EVALUATION, {"worker": ""}, "worker is not a name"),
    (EVALUATION, {"worker": "a/b"}, "worker is not a name"),
    *[
        (EPISODE, {name: -1}, f"{name} -1 is outside 0")
        for name in ("arena", "episode", "frames", "collisions", "weights_version")
    ],
    (EPISODE, {"score": NAN}, "score nan"),
    (EPISODE, {"epsilon": 1.5}, "epsilon 1.5 is outside 0 ... 1"),
    (EPISODE, {"actor": "\n"}, "actor is not a name"),
    *[
        (LEARNER, {"metrics": {"learner_steps": value}}, "metric learner_steps .* is outside 0")
        for value in (-1.0, 1e19, NAN, INF)
    ],
    *[
        (LEARNER, {"metrics": {"weights_version": value}}, "metric weights_version")
        for value in (NAN, -INF, 1e300)
    ],
    (LEARNER, {"metrics": {"step_share": NAN}}, "metric step_share"),
    (LEARNER, {"metrics": {"of_nobody": NAN}}, "metric of_nobody"),
    (LEARNER, {"role": "foreign", "metrics": {"slot": NAN}}, "metric slot"),
    (LEARNER, {"metrics": {"x" * 65: 1.0}}, "is not a name"),
    (LEARNER, {"metrics": {ESCAPE: 1.0}}, r"called '\\\\x1b\[31m', which is not a name"),
    (LEARNER, {"metrics": {"": 1.0}}, "is not a name"),
    (LEARNER, {"metrics": {f"m{i}": 1.0 for i in range(MAX_METRICS + 1)}}, "257 metrics"),
    (LEARNER, {"text": {f"t{i}": "" for i in range(MAX_TEXTS + 1)}}, "33 texts"),
    (LEARNER, {"text": {"python": ESCAPE}}, "text python is not printable"),
    (LEARNER, {"text": {"python": "3" * (MAX_TEXT + 1)}}, "longer than 256"),
    (LEARNER, {"text": {ESCAPE: "1"}}, "is not a name"),
    (LEARNER, {"role": ESCAPE}, "role is not a name"),
    (LEARNER, {"id": "x" * 65}, "id is not a name of up to 64"),
    (WEIGHTS, {"version": -1}, "version -1 is outside 0"),
    (WEIGHTS, {"epoch": -1}, "epoch -1 is outside 0"),
    (WEIGHTS, {"learner_step": -1}, "learner_step -1 is outside 0"),
    (InsertReply(1, False, 2), {"inserts": -1}, "inserts -1 is outside 0"),
    (PrioritiesReply(1, 2), {"ignored": -1}, "ignored -1 is outside 0"),
    (SampleRequest(32), {"learner_step": -2}, "learner_step -2 is outside -1"),
    (CHUNK, {"actor": ESCAPE}, "actor is not a name"),
    *[
        (message, {"discounts": floats(1, value)}, "a discount is outside 0 ... 1")
        for message in (CHUNK, SAMPLES)
        for value in (-0.1, 1.5, NAN, INF)
    ],
    (SAMPLES, {"rewards": floats(1, NAN)}, "a reward is not finite"),
    (SAMPLES, {"actions": [[2], b"\0\x40"]}, "an action is not below 64"),
    (SAMPLES, {"bootstrap_offsets": [[2], b"\1\0"]}, "offset is 0"),
    (SAMPLES, {"table_size": 0}, "table_size 0 is outside 1"),
]


@pytest.mark.parametrize("message", SOUND, ids=lambda m: type(m).__name__)
def test_a_sound_message_is_taken(message: Any) -> None:
    decode(type(message), changed(message))


@pytest.mark.parametrize(("message", "fields", "reason"), ODD)
def test_a_value_that_nobody_sends_is_refused(message: Any, fields: Any, reason: str) -> None:
    with pytest.raises(WireError, match=reason) as refused:
        decode(type(message), changed(message, **fields))
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 250


def test_an_unknown_field_is_named_in_printable_text() -> None:
    with pytest.raises(WireError, match="unknown fields") as refused:
        decode(Stats, changed(LEARNER, **{ESCAPE * 100: 1}))
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 250


def test_what_shows_that_learning_diverges_may_be_no_number() -> None:
    metrics = {"loss": NAN, "q_max": INF, "mean_q": -INF}
    found = decode(Stats, changed(LEARNER, metrics=metrics))
    assert found.metrics.keys() == metrics.keys()
    for far in (1e308, -1e39):  # no learner computes that
        with pytest.raises(WireError, match=r"metric loss .* is outside"):
            decode(Stats, changed(LEARNER, metrics={"loss": far}))
    decode(EpisodeSummary, changed(EPISODE, mean_q=NAN))


def test_as_many_robots_as_the_schema_allows_may_be_evaluated() -> None:
    schema = ArenaConfig.model_json_schema()["properties"]["num_robots"]
    for count in (schema["minimum"], schema["maximum"]):
        decode(Evaluation, encode(dataclasses.replace(EVALUATION, num_robots=count)))


def test_every_metric_of_ours_is_a_name_and_all_fit() -> None:
    for schema in (LearnerMetrics, EvaluatorMetrics):
        names = kinds(schema)
        assert all(map(is_name, names))
        assert len(names) < MAX_METRICS


@pytest.mark.parametrize(
    ("message", "key"),
    [
        (EVALUATION, "mrcdrl/run/evaluation/e"),
        (EPISODE, "mrcdrl/run/episodes/a"),
        (LEARNER, "mrcdrl/run/stats/learner/0"),
    ],
)
def test_a_publication_names_its_keys_sender(message: Any, key: str) -> None:
    cls, data = type(message), encode(message)
    assert decode_published(cls, key, data) == message
    for other in (f"{key}x", f"{key}/x", key.rpartition("/")[0], key.rpartition("/")[0] + "/*"):
        with pytest.raises(WireError, match=r"a message of .* on key mrcdrl/run"):
            decode_published(cls, other, data)
    with pytest.raises(WireError) as refused:
        decode_published(cls, f"mrcdrl/{ESCAPE}/b", data)
    assert str(refused.value).isprintable()


def test_a_role_of_another_key_is_refused() -> None:
    with pytest.raises(WireError, match=r"a message of learner/0 on key .*actor/0"):
        decode_published(Stats, "mrcdrl/run/stats/actor/0", encode(LEARNER))


def test_text_of_a_peer_is_bounded_and_printable() -> None:
    assert printable("as it is — ü") == "as it is — ü"
    assert printable("a\x1b[2J\r\nb\x9b\u202e") == "a\\x1b[2J\\r\\nb\\x9b\\u202e"
    long = printable("\0" * 10**6)
    assert long.isprintable()
    assert len(long) <= 4 * MOST_SHOWN + 1


def test_a_line_of_a_million_metrics_is_refused_whole() -> None:
    table = msgpack.unpackb(encode(LEARNER)) | {"metrics": {f"m{i}": 0.0 for i in range(100_000)}}
    with pytest.raises(WireError, match="100000 metrics"):
        decode(Stats, msgpack.packb(table))
