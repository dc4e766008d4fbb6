"""The schema of metrics: what is sent, under which names, and how it is read back."""

import pytest

from mrcdrl.common.messages.metrics import (
    NUM_BINS,
    SCHEMAS,
    ActorMetrics,
    DiagnosticMetrics,
    LearnerMetrics,
    kinds,
    numbers,
    of_kind,
    read,
)


def learner(diagnostics: DiagnosticMetrics | None) -> LearnerMetrics:
    own = [name for name in kinds(LearnerMetrics) if name not in kinds(DiagnosticMetrics)]
    return LearnerMetrics(**dict.fromkeys(own, 1.0), diagnostics=diagnostics)  # type: ignore[arg-type]


def test_all_names_are_sent_once_the_histograms_are_there() -> None:
    shown = dict.fromkeys(list(kinds(DiagnosticMetrics))[:13], 2.0)
    bins = tuple(i / 10 for i in range(NUM_BINS))
    sent = numbers(learner(DiagnosticMetrics(**shown, q_bin=bins, td_error_bin=bins)))
    assert list(sent) == list(kinds(LearnerMetrics))
    assert (sent["step_share"], sent["loss"], sent["td_error_bin_7"]) == (1.0, 2.0, 0.7)


@pytest.mark.parametrize(
    ("diagnostics", "missing"),
    [
        (None, set(kinds(DiagnosticMetrics))),
        (
            read(DiagnosticMetrics, {}),
            {n for n, kind in kinds(LearnerMetrics).items() if kind == "histogram"},
        ),
    ],
)
def test_what_is_absent_is_not_sent(
    diagnostics: DiagnosticMetrics | None, missing: set[str]
) -> None:
    assert kinds(LearnerMetrics).keys() - numbers(learner(diagnostics)).keys() == missing


@pytest.mark.parametrize("role", SCHEMAS)
def test_metrics_read_back_to_what_was_sent(role: str) -> None:
    metrics = read(SCHEMAS[role], {name: float(i) for i, name in enumerate(kinds(SCHEMAS[role]))})
    assert read(SCHEMAS[role], numbers(metrics)) == metrics


def test_a_missing_metric_is_read_as_zero_and_an_unknown_one_ignored() -> None:
    metrics = read(ActorMetrics, {"env_steps": 3.0, "of_another_version": 1.0})
    assert (metrics.env_steps, metrics.robot_steps) == (3.0, 0.0)


def test_recorded_rates_keep_their_order() -> None:
    assert of_kind("pace") == {
        "actor": ("env_steps", "robot_steps"),
        "learner": ("learner_steps",),
        "replay": ("inserts", "samples"),
        "evaluator": (),
    }
