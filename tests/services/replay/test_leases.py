"""Leases of exploration slots: who gets which, and that two actors never hold the same one."""

from dataclasses import dataclass, field

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseReply, LeaseRequest
from mrcdrl.services.actor.lease import ALONE, Lease
from mrcdrl.services.replay.leases import LeaseTable

LEASE_S = 10.0
ANSWER_S = 2.0


def opened(num_places: int = 0) -> LeaseTable:
    """A table that is past the time when only claimed slots are granted."""
    return LeaseTable(LEASE_S, num_places, -LEASE_S)


def wish(
    actor: str, incarnation: int = 1, slot: int = NO_SLOT, *, holds: bool = False
) -> LeaseRequest:
    return LeaseRequest(actor, incarnation, slot, holds, ends=False)


def ends(actor: str, incarnation: int = 1) -> LeaseRequest:
    return LeaseRequest(actor, incarnation, NO_SLOT, holds=False, ends=True)


def test_the_lowest_free_slot_is_granted_and_renewed() -> None:
    table = opened()
    assert [table.answer(wish(name), 0).slot for name in "abc"] == [0, 1, 2]
    assert table.answer(ends("b"), 1).slot == NO_SLOT
    assert table.answer(wish("d"), 1).slot == 1
    assert table.answer(wish("a"), 9).slot == 0
    assert table.answer(wish("e"), 10).slot == 2, "c did not renew its lease"
    assert table.answer(wish("c"), 10).slot == 3


def test_the_rank_counts_the_lower_slots_that_are_held() -> None:
    table = opened()
    replies = [table.answer(wish(name), 0) for name in "abc"]
    assert (replies[2].rank, replies[2].num_places) == (2, 3)
    table.answer(ends("b"), 1)
    c = table.answer(wish("c", slot=2, holds=True), 1)
    assert (c.slot, c.rank, c.num_places) == (2, 1, 2)


def test_a_schedule_of_a_set_size_grants_no_more_slots() -> None:
    table = opened(num_places=2)
    assert table.answer(wish("a"), 0) == LeaseReply(0, 0, 2, LEASE_S)
    assert table.answer(wish("b"), 0) == LeaseReply(1, 1, 2, LEASE_S)
    assert table.answer(wish("c"), 0).slot == NO_SLOT
    table.answer(ends("a"), 1)
    assert table.answer(wish("c", slot=7), 1).slot == 0, "7 is not a slot of this schedule"


def test_a_restarted_actor_gets_its_own_slot_once_that_is_free() -> None:
    table = opened()
    for name in "abc":
        table.answer(wish(name), 0)
    table.answer(wish("c", slot=2, holds=True), 5)
    assert table.answer(wish("a", incarnation=2), 6).slot == 3, (
        "its earlier start may still be alive"
    )
    assert table.answer(wish("b", incarnation=2), 11).slot == 1, "not 0, which is also free"


def test_a_lost_slot_is_not_taken_back() -> None:
    table = opened()
    table.answer(wish("a"), 0)
    assert table.answer(wish("b"), 10).slot == 0
    assert table.answer(wish("a", slot=0), 11).slot == 1


def test_a_late_end_does_not_free_another_actors_slot() -> None:
    table = opened()
    table.answer(wish("a"), 0)
    table.answer(wish("b"), 10)
    table.answer(ends("a"), 11)
    assert table.answer(wish("c"), 11).slot == 1


def test_after_a_start_holders_claim_their_slots_before_others_get_any() -> None:
    table = LeaseTable(LEASE_S, 0, 100)
    assert table.answer(wish("new"), 101).slot == NO_SLOT
    assert table.answer(wish("was away too long", slot=1), 101).slot == NO_SLOT
    assert table.answer(wish("a", slot=4, holds=True), 102).slot == 4
    assert table.answer(wish("b", slot=4, holds=True), 102).slot == NO_SLOT
    assert table.answer(wish("new"), 110).slot == 0


def test_an_actor_loses_its_slot_by_its_own_clock() -> None:
    lease = Lease("a", 1)
    assert lease.rank(0) == ALONE
    lease.take(LeaseReply(3, 2, 5, LEASE_S), asked_s=100)
    assert (lease.slot(108.9), lease.rank(108.9)) == (3, (2, 5))
    assert lease.request(106, ANSWER_S).holds
    assert not lease.request(108, ANSWER_S).holds, "it may be over when the claim arrives"
    assert (lease.slot(109), lease.rank(109)) == (NO_SLOT, ALONE)
    assert lease.request(109, ANSWER_S).slot == 3, "what it would have again"


def test_an_answer_that_was_long_under_way_gives_nothing() -> None:
    lease = Lease("a", 1)
    lease.take(LeaseReply(3, 2, 5, LEASE_S), asked_s=0)
    assert lease.slot(60) == NO_SLOT


@dataclass
class Asked:
    """A request in flight, or its answer."""

    request: LeaseRequest
    asked_s: float  # by the actor's clock
    sent_s: float  # in truth
    table: int  # that was there when it was sent
    reply: LeaseReply | None = None


@dataclass
class Actor:
    """A process; the test checks what it believes to hold."""

    name: str
    rate: float  # of its clock
    lease: Lease
    under_way: list[Asked] = field(default_factory=list)


class LeasesAgainstTime(RuleBasedStateMachine):
    """Actors ask, are paused, killed and restarted; messages are late or lost, replay restarts, and
    all clocks run at different rates: no two actors ever believe to hold the same slot."""

    @initialize(num_places=st.sampled_from([0, 0, 2]), rate=st.floats(0.96, 1.04))
    def begin(self, num_places: int, rate: float) -> None:
        self.now_s = 0.0
        self.num_places, self.rate = num_places, rate
        self.started, self.tables = 2, 1
        self.actors = [Actor("a", 1.0, Lease("a", 1)), Actor("b", 0.97, Lease("b", 2))]
        self.table = opened(num_places)

    @rule()
    def start_replay(self) -> None:
        self.tables += 1
        self.table = LeaseTable(LEASE_S, self.num_places, self.rate * self.now_s)

    @precondition(lambda self: len(self.actors) < 4)
    @rule(name=st.sampled_from("abc"), rate=st.floats(0.96, 1.04))
    def start_actor(self, name: str, rate: float) -> None:
        self.started += 1
        self.actors.append(Actor(name, rate, Lease(name, self.started)))

    @precondition(lambda self: self.actors)
    @rule(data=st.data())
    def kill_actor(self, data: st.DataObject) -> None:
        self.actors.remove(data.draw(st.sampled_from(self.actors)))

    @precondition(lambda self: self.actors)
    @rule(data=st.data(), end=st.booleans())
    def ask(self, data: st.DataObject, end: bool) -> None:
        actor = data.draw(st.sampled_from(self.actors))
        clock = actor.rate * self.now_s
        request = actor.lease.request(clock, ANSWER_S, ends=end)
        actor.under_way.append(Asked(request, clock, self.now_s, self.tables))
        if end:  # it works no more
            self.actors.remove(actor)
            self.arrive(actor.under_way[-1])

    @precondition(lambda self: any(actor.under_way for actor in self.actors))
    @rule(data=st.data(), lost=st.booleans())
    def carry(self, data: st.DataObject, lost: bool) -> None:
        """A message reaches the other end, or is lost."""
        actor = data.draw(st.sampled_from([a for a in self.actors if a.under_way]))
        asked = data.draw(st.sampled_from(actor.under_way))
        if lost:
            actor.under_way.remove(asked)
        elif asked.reply is None:
            self.arrive(asked)
        else:
            actor.under_way.remove(asked)
            actor.lease.take(asked.reply, asked.asked_s)

    @precondition(lambda self: self.actors)
    @rule(data=st.data())
    def ask_and_hear(self, data: st.DataObject) -> None:
        actor = data.draw(st.sampled_from(self.actors))
        self.renew(actor)

    @rule(seconds=st.sampled_from([0.1, 1.0, 3.0, 8.9, 9.1, 10.0, 11.0, 40.0]))
    def wait(self, seconds: float) -> None:
        self.now_s += seconds

    def arrive(self, asked: Asked) -> None:
        """Reach replay; an earlier replay process's request only until it times out."""
        if asked.table == self.tables or self.now_s - asked.sent_s < 0.9 * ANSWER_S:
            asked.reply = self.table.answer(asked.request, self.rate * self.now_s)

    def renew(self, actor: Actor) -> None:
        clock = actor.rate * self.now_s
        request = actor.lease.request(clock, ANSWER_S)
        actor.lease.take(self.table.answer(request, self.rate * self.now_s), clock)

    @invariant()
    def no_two_hold_one(self) -> None:
        self.table.check_invariants()
        slots = [actor.lease.slot(actor.rate * self.now_s) for actor in self.actors]
        held = [slot for slot in slots if slot != NO_SLOT]
        assert len(held) == len(set(held)), slots

    def teardown(self) -> None:
        """Whatever happened before: once all keep asking, each has its own rank."""
        for _ in range(8):
            self.now_s += LEASE_S / 3
            for actor in self.actors:
                self.renew(actor)
        for actor in self.actors:
            self.renew(actor)
        places = [actor.lease.rank(actor.rate * self.now_s) for actor in self.actors]
        if not self.num_places:
            assert sorted(places) == [(rank, len(places)) for rank in range(len(places))]
        holders = sum(actor.lease.slot(actor.rate * self.now_s) >= 0 for actor in self.actors)
        assert holders == min(len(self.actors), self.num_places or len(self.actors))


TestLeasesAgainstTime = LeasesAgainstTime.TestCase
TestLeasesAgainstTime.settings = settings(max_examples=150, stateful_step_count=40)


@pytest.mark.parametrize("count", [1, 7])
def test_the_repr_shows_the_holders(count: int) -> None:
    table = opened()
    for number in range(count):
        table.answer(wish(f"actor-{number}"), 0)
    assert len(table) == count
    assert f"{count - 1}: ('actor-{count - 1}', 1)" in repr(table)
