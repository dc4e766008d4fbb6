"""`mrcdrl evaluator`: join a run and evaluate its live weights until told to stop."""

from collections.abc import Sequence

import torch

from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal, yield_cores
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Session
from mrcdrl.services.evaluator.evaluator import Evaluator

# Evaluating yields to learning on shared cores; not at first, so that a short run has a result too.
_NICE = 10


def main(argv: Sequence[str]) -> int:
    """Evaluate for a run; return the exit code."""
    joining = Joining.from_argv("evaluator", argv)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session:
        config = fetch_config(session, joining, stop)
        claim_name(session, joining.keys, "evaluator", joining.worker, stop)
        torch.set_num_threads(config.evaluator.threads)
        evaluator = Evaluator(config, joining, session, stop, lambda: yield_cores(_NICE))
        session.announce(joining.keys.live("evaluator", joining.worker))
        evaluator.run()
        yield_cores(0)  # the end is not to wait for cores
    return 0
