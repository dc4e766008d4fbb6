"""`/metrics` of the page's server: what is followed of the runs that are up, for Prometheus.

A scrape counts as looking: it has the server follow the runs that are up, as many as it may. The
next one finds them joined.
"""

import anyio
from anyio.to_thread import run_sync
from prometheus_client import generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from mrcdrl.services.monitor.prometheus import registry
from mrcdrl.services.monitor.run_info import State
from mrcdrl.services.web.folder import RunFolder
from mrcdrl.services.web.following import Runs


def metrics_route(folder: RunFolder, runs: Runs) -> Route:
    """The route, to be given to `make_app`."""
    collected, one = registry(runs.measured), anyio.CapacityLimiter(1)

    async def metrics(_: Request) -> Response:
        infos = await run_sync(folder.infos, limiter=one)
        runs.follow(folder.path.resolve() / i.name for i in infos if i.state is State.RUNNING)
        text = await run_sync(generate_latest, collected, limiter=one)
        return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})

    return Route("/metrics", metrics)
