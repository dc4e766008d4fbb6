"""`mrcdrl train`: one command from the first frame to an evaluated policy, on this machine."""

import logging
import sys
from collections.abc import Sequence

from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.stopping import failed
from mrcdrl.services.train.ending import ending, ending_as_json
from mrcdrl.services.train.fleet import Fleet
from mrcdrl.services.train.forecast import forecast
from mrcdrl.services.train.launcher import expectation, plan_run, supervise, write_plots
from mrcdrl.services.train.page import Page

_LOG = logging.getLogger("train")


def main(argv: Sequence[str]) -> int:
    """Train; the exit code."""
    plan = plan_run(argv)
    if plan.dry_run:
        sys.stdout.write(forecast(plan))
        return 0
    with plan.open() as run:
        hurry = StopSignal()
        stop = StopSignal().listen(then=hurry)
        prefix = "resuming " if run.resumed else ""
        _LOG.info("%srun %s: %s", prefix, run.path, expectation(run.config))
        fleet = Fleet(run.logs)
        try:
            with (
                Recorder(run.path, run.config) as recorder,
                Page(run, wanted=plan.page) as page,
            ):
                try:
                    reason = supervise(run, fleet, recorder, stop, hurry, page)
                except MrcdrlError as error:
                    recorder.summarize(failed(str(error)))
                    raise
                fleet.stop()
                if plan.plots:
                    _LOG.info("%s; writing plots and video (Ctrl-C skips them) …", reason)
                    write_plots(run.path, hurry)
                recorder.record_pictures()
        finally:
            fleet.stop()
    sys.stdout.write(ending_as_json(run.path) if plan.json else ending(run.path, reason))
    return 0
