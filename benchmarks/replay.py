"""Measure our replay service in a harness for other systems: their workload, on the same cores.

The harness (`common.py` of --peers) makes frames and drives a server, a writer and a sampler, each
in its own process; here they are our service and its real clients over Zenoh. Codecs:

    frames   images of 3 600 bytes, as the other systems store them
    records  scenes of 80 bytes (4 robots), sampled without rendering, as when a GPU renders
    drawn    the same scenes, with all images of a batch rendered by the sampler

Prints the harness's line of JSON, transitions a second, with our machine and versions. Pin it like
the others: `taskset -c 2,3 python -m benchmarks.replay --peers DIR --codec frames`. Needs psutil.
"""

import argparse
import contextlib
import io
import os
import tempfile
from pathlib import Path

from benchmarks.machine import emit
from mrcdrl.common.runtime.process import ALLOCATOR

HARNESS = "peers_harness"  # the harness's own name, `common`, is ambiguous
LINKED = "MRCDRL_BENCH_HARNESS"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path, required=True, help="the directory of the harness")
    parser.add_argument("--codec", choices=["frames", "records", "drawn"], default="frames")
    parser.add_argument("--fsync", choices=["never", "always", "off"], default="never")
    parser.add_argument("--log-dir", help="directory for the log; default: the system's")
    parser.add_argument("--network", action="store_true", help="without shared memory")
    parser.add_argument("--drawing-threads", type=int, default=0, help="0: one per core")
    parser.add_argument("--spool", type=int, default=8, help="most unacknowledged chunks")
    parser.add_argument("--request", type=int, default=512, help="transitions per sample request")
    parser.add_argument(
        "--backlog", type=int, default=64, help="most waiting batches of priorities"
    )
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        (Path(folder) / f"{HARNESS}.py").symlink_to(peers_of(parser) / "common.py")
        (Path(folder) / "pool.npz").symlink_to(peers_of(parser) / "pool.npz")
        os.environ |= ALLOCATOR  # as `mrcdrl train` does for its processes
        os.environ[LINKED] = folder
        from benchmarks import replay_roles as roles

        arguments = roles.base.std_args(parser).parse_args()
        extra = {"codec": arguments.codec, "fsync": arguments.fsync, "network": arguments.network}
        classes = (roles.Server, roles.Writer, roles.Sampler)
        with contextlib.redirect_stdout(io.StringIO()):  # the harness prints its line itself
            figures = roles.base.drive("mrcdrl", arguments, *classes, extra=extra)
        emit(figures)


def peers_of(parser: argparse.ArgumentParser) -> Path:
    """The harness's directory, read before the harness adds its own flags."""
    peers: Path = parser.parse_known_args()[0].peers.resolve()
    return peers


if __name__ == "__main__":
    main()
