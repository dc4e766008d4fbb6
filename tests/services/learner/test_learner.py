"""The learner learns what is known to be right, and goes on exactly where it was."""

import dataclasses
from typing import Literal

import numpy as np
import pytest
import torch

from mrcdrl.common.config import AgentConfig, LearnerConfig
from mrcdrl.common.errors import CheckpointError, ConfigError, DivergedError
from mrcdrl.common.messages.trajectory import Float32Array
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")
VIEW_PX = 31
FLOAT32 = LearnerConfig(precision="float32", device="cpu")


def make_learner(
    agent: AgentConfig | None = None, learner: LearnerConfig = FLOAT32, stack: int = 4
) -> Learner:
    return Learner(agent or AgentConfig(), learner, stack=stack, view_px=VIEW_PX)


def random_batch(size: int = 8, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    shape = (2, size, 4, VIEW_PX, VIEW_PX)
    images = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
    return Batch(
        observation=images[0],
        action=torch.randint(0, 3, (size,), generator=generator),
        reward=torch.randn(size, generator=generator),
        discount=torch.full((size,), 0.99),
        next_observation=images[1],
        importance_weights=torch.ones(size),
        keys=np.arange(size),
    )


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_handful_of_transitions_is_learned_by_heart(
    optimizer: Literal["adam", "rmsprop"], precision: Literal["float32", "bfloat16"]
) -> None:
    learner = make_learner(
        AgentConfig(optimizer=optimizer, learning_rate=5e-4, optimizer_epsilon=1e-5),
        LearnerConfig(precision=precision, device="cpu"),
    )
    batch = dataclasses.replace(random_batch(), discount=torch.zeros(8))
    first = float(learner.step(batch).loss)
    for _ in range(120):
        update = learner.step(batch)
    assert float(update.loss) < 0.02 * first
    assert learner.learner_step == 121


# A walk on five places: left, stay, right (actions 0, 1, 2). Entering place 4 pays 1 and ends.
PLACES = 5
GAMMA = 0.7


def walk() -> tuple[Batch, Float32Array]:
    """All transitions out of places 0 to 3, and the optimal values [4, 3]."""
    images = torch.zeros((PLACES, 1, VIEW_PX, VIEW_PX), dtype=torch.uint8)
    for place in range(PLACES):
        images[place, :, :, place * 6 : place * 6 + 6] = 255
    places = torch.arange(PLACES - 1).repeat_interleave(3)
    actions = torch.arange(3).repeat(PLACES - 1)
    following = (places + actions - 1).clamp(0, PLACES - 1)
    ends = following == PLACES - 1
    batch = Batch(
        observation=images[places],
        action=actions,
        reward=ends.float(),
        discount=torch.where(ends, 0.0, GAMMA),
        next_observation=images[following],
        importance_weights=torch.ones(len(places)),
        keys=np.arange(len(places)),
    )
    optimal = torch.zeros((PLACES, 3))
    for _ in range(200):
        best = optimal.max(dim=1).values[following]
        optimal[:-1] = (batch.reward + batch.discount * best).reshape(-1, 3)
    return batch, optimal[:-1].numpy()


@pytest.mark.parametrize("kind", ["duel", "ddqn", "dqn"])
def test_a_small_decision_process_is_solved_to_its_optimal_values(
    kind: Literal["duel", "ddqn", "dqn"],
) -> None:
    batch, optimal = walk()
    np.testing.assert_allclose(optimal[:, 2], [GAMMA**3, GAMMA**2, GAMMA, 1.0], rtol=1e-6)
    agent = AgentConfig(kind=kind, gamma=GAMMA, learning_rate=5e-4, target_period=40)
    learner = make_learner(agent, stack=1)
    for _ in range(800):
        learner.step(batch)
    with torch.no_grad():
        values = learner.online(batch.observation[::3]).numpy()
    np.testing.assert_allclose(values, optimal, atol=0.03)
    assert (values.argmax(axis=1) == 2).all()


def test_a_truncated_episode_bootstraps_and_a_terminated_one_does_not() -> None:
    learner = make_learner()
    batch = random_batch(size=2)
    batch = dataclasses.replace(
        batch, discount=torch.tensor([0.9, 0.0]), reward=torch.tensor([1.0, 1.0])
    )
    with torch.no_grad():
        q = learner.online(batch.observation).gather(1, batch.action[:, None])[:, 0]
        best = learner.target(batch.next_observation).max(dim=1).values
    expected = torch.stack([1.0 + 0.9 * best[0] - q[0], 1.0 - q[1]])
    torch.testing.assert_close(learner.step(batch).td_errors, expected)


def test_rewards_are_scaled_once() -> None:
    batch = dataclasses.replace(random_batch(), discount=torch.zeros(8))
    plain = make_learner().step(batch).td_errors
    scaled = make_learner(AgentConfig(reward_scale=0.1)).step(batch).td_errors
    torch.testing.assert_close(plain - scaled, 0.9 * batch.reward)


def test_the_target_is_copied_every_period_and_stays_between() -> None:
    learner = make_learner(AgentConfig(target_period=3))
    first = {name: value.clone() for name, value in learner.target.state_dict().items()}
    for step in range(1, 7):
        learner.step(random_batch(seed=step))
        same = all(
            torch.equal(value, learner.online.state_dict()[name])
            for name, value in learner.target.state_dict().items()
        )
        assert same == (step % 3 == 0), step
        if step < 3:
            assert all(torch.equal(v, first[n]) for n, v in learner.target.state_dict().items())


def test_a_long_gradient_is_clipped() -> None:
    """Plain steps of RMSprop hide the length, so the gradients themselves are looked at."""
    batch = dataclasses.replace(random_batch(), reward=torch.full((8,), 1000.0))
    for limit in (0.5, 0.0):
        learner = make_learner(AgentConfig(max_gradient_norm=limit))
        before = float(learner.step(batch).gradient_norm)
        gradients = [p.grad for p in learner.online.parameters() if p.grad is not None]
        after = float(torch.nn.utils.get_total_norm(gradients))
        assert before > 100
        assert after == pytest.approx(limit or before, rel=1e-3)


def test_the_seed_alone_decides_the_first_parameters() -> None:
    torch.manual_seed(123)
    before = torch.get_rng_state()
    payloads = [make_learner(learner=FLOAT32).payload() for _ in range(2)]
    other = make_learner(learner=LearnerConfig(precision="float32", seed=1)).payload()
    assert payloads[0] == payloads[1] != other
    assert torch.equal(before, torch.get_rng_state()), "the global generator is left alone"


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
@pytest.mark.parametrize("steps_before", [0, 5])
def test_a_restored_learner_goes_on_bit_for_bit(
    optimizer: Literal["adam", "rmsprop"], steps_before: int
) -> None:
    agent = AgentConfig(optimizer=optimizer, target_period=4)
    whole = make_learner(agent)
    for step in range(steps_before):
        whole.step(random_batch(seed=step))
        whole.rng.random()
    state = whole.state()
    resumed = make_learner(agent, LearnerConfig(precision="float32", device="cpu", seed=99))
    resumed.restore(state)
    assert resumed.state() == state
    for step in range(steps_before, steps_before + 5):
        one, two = (learner.step(random_batch(seed=step)) for learner in (whole, resumed))
        assert torch.equal(one.loss, two.loss)
        assert torch.equal(one.td_errors, two.td_errors)
    assert resumed.state() == whole.state()
    assert resumed.rng.random() == whole.rng.random()


def test_a_state_is_not_changed_by_later_steps() -> None:
    learner = make_learner()
    learner.step(random_batch())
    state = learner.state()
    copy = dataclasses.replace(state)
    learner.step(random_batch())
    assert state == copy
    assert learner.state() != state


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (AgentConfig(kind="dqn"), "dqn network"),
        (AgentConfig(optimizer="rmsprop"), "not rmsprop"),
    ],
)
def test_a_state_of_another_agent_is_refused(agent: AgentConfig, message: str) -> None:
    learner = make_learner()
    learner.step(random_batch())
    with pytest.raises(CheckpointError, match=message):
        make_learner(agent).restore(learner.state())


def test_half_precision_is_of_what_is_published_alone() -> None:
    halved = make_learner(learner=FLOAT32.model_copy(update={"publish_precision": "bfloat16"}))
    exact = make_learner()
    for step in range(3):
        halved.step(random_batch(seed=step))
        exact.step(random_batch(seed=step))
    assert halved.state() == exact.state()
    assert len(halved.payload()) < 0.51 * len(exact.payload())


def test_diverged_weights_are_not_published() -> None:
    learner = make_learner()
    learner.step(dataclasses.replace(random_batch(), reward=torch.full((8,), torch.nan)))
    for refused in (learner.payload, learner.state):
        with pytest.raises(
            DivergedError, match=r"diverged by step 1: .* not finite.*--resume"
        ) as e:
            refused()
        assert "\n" not in str(e.value)


def test_moments_that_are_not_finite_are_not_saved() -> None:
    """The parameters are still whole: Adam divides by the root of infinity."""
    learner = make_learner(AgentConfig(max_gradient_norm=0.0, loss="squared"))
    learner.step(dataclasses.replace(random_batch(), reward=torch.full((8,), 1e24)))
    learner.payload()
    with pytest.raises(DivergedError, match="moments that are not finite"):
        learner.state()


@pytest.mark.parametrize("device", ["warp", "cuda:x"])
def test_a_device_that_is_none_is_refused(device: str) -> None:
    with pytest.raises(ConfigError, match=r"learner\.device"):
        make_learner(learner=LearnerConfig(device=device))


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
def test_the_learning_rate_follows_its_schedule(optimizer: Literal["adam", "rmsprop"]) -> None:
    """After the schedule has fallen a thousandfold a step changes next to nothing."""
    agent = AgentConfig(
        optimizer=optimizer,
        learning_rate=1e-2,
        optimizer_epsilon=1e-5,
        learning_rate_schedule=((0, 1.0), (4, 1e-3)),
    )
    learner, batch = make_learner(agent), random_batch()
    moved = []
    for _ in range(6):
        before = [p.detach().clone() for p in learner.online.parameters()]
        learner.step(batch)
        after = [p.detach() for p in learner.online.parameters()]
        moved.append(max(float((a - b).abs().max()) for a, b in zip(after, before, strict=True)))
    assert moved[0] > 100 * moved[4]
    assert moved[4] == pytest.approx(moved[5], rel=2.0)


def test_an_impossible_schedule_is_refused() -> None:
    with pytest.raises(ValueError, match="learning_rate_schedule needs points"):
        AgentConfig(learning_rate_schedule=((5, 1.0),))
    with pytest.raises(ValueError, match="factor that is not above 0"):
        AgentConfig(learning_rate_schedule=((0, 0.0),))
