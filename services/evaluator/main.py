"""`mrcdrl evaluator`: join a run and evaluate its live weights until told to stop."""

from collections.abc import Sequence

import torch

from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal, yield_cores
from mrcdrl.common.sync.broadcast import Broadcast
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.stats import serve_statistics
from mrcdrl.common.transport import Session
from mrcdrl.services.evaluator.evaluator import Evaluator

# Evaluating yields to learning on shared cores; not at first, so that a short run has a result too.
_NICE = 10
_AHEAD = 900  # frames that people may see after an evaluation: it plays fast, and then rests


def main(argv: Sequence[str]) -> int:
    """Evaluate for a run; return the exit code."""
    joining = Joining.from_argv("evaluator", argv)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session:
        config = fetch_config(session, joining, stop, plays=True)
        claim_name(session, joining.keys, "evaluator", joining.worker, stop)
        torch.set_num_threads(config.evaluator.threads)
        shown = session.watched_publisher(joining.keys.arena("evaluator", joining.worker))
        with Broadcast(shown, "evaluator", joining.worker, _AHEAD) as broadcast:
            evaluator = Evaluator(
                config, joining, session, stop, lambda: yield_cores(_NICE), broadcast
            )
            session.announce(joining.keys.live("evaluator", joining.worker))
            with serve_statistics(joining.transport, "evaluator", joining.run, evaluator.reporter):
                evaluator.run()
        yield_cores(0)  # the end is not to wait for cores
    return 0
