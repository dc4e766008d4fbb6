"""When the table may be sampled: as the rate limiter allows, or turn by turn in lockstep.

Invariant: pure; the service calls it under its lock.
"""

from dataclasses import dataclass

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import SampleRequest
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.table import Table

_TOO_FEW_INSERTS = "the actors have not inserted enough for another sample yet"


@dataclass(frozen=True, slots=True)
class RateLimited:
    """Admits samples as fast as the rate limiter allows, from one random stream."""

    limiter: RateLimiter

    def can_sample(self, request: SampleRequest) -> bool:
        """Whether the request can be met now."""
        return self.limiter.can_sample(request.batch_size)

    def reseed(self, request: SampleRequest) -> None:
        """Leave the random stream as it is."""

    def why_not(self, request: SampleRequest) -> str:
        """Why the request cannot be met yet."""
        inserts, min_size = self.limiter.inserts, self.limiter.min_size
        if inserts < min_size:
            return f"the table holds {inserts} of the first {min_size} transitions"
        return _TOO_FEW_INSERTS


@dataclass(frozen=True, slots=True)
class InLockstep:
    """Admits samples from exactly the transitions due at a learner step, seeded by that step.

    A learner that asks for the same step again is given the same samples.
    """

    lockstep: Lockstep
    table: Table
    seed: int

    def can_sample(self, request: SampleRequest) -> bool:
        """Whether the request can be met now; raises WireError if it never can."""
        step, inserts = request.learner_step, self.table.next_key
        if step < 0:
            raise WireError("in lockstep a sample request must state its learner step")
        due = self.lockstep.inserts(step)
        if inserts > due:
            raise WireError(
                f"{inserts} transitions where {due} are due at learner step {step}: "
                "another actor, or a checkpoint older than the last turn?"
            )
        return inserts == due

    def reseed(self, request: SampleRequest) -> None:
        self.table.sampler.rng = np.random.default_rng((self.seed, request.learner_step))

    def why_not(self, request: SampleRequest) -> str:
        return _TOO_FEW_INSERTS


SampleAdmission = RateLimited | InLockstep


def make_admission(config: Config, table: Table, limiter: RateLimiter) -> SampleAdmission:
    """The admission a configuration asks for."""
    lockstep = Lockstep.from_config(config)
    return InLockstep(lockstep, table, config.replay.seed) if lockstep else RateLimited(limiter)
