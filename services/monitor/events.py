"""TensorBoard events, written by whoever records them.

tensorboardX's own writer hands them to a thread. When the disk is full that thread ends, and ten
events later its caller waits without end.
"""

import os
import socket
import struct
import time
from pathlib import Path
from typing import Any

from mrcdrl.common.runtime.closing import Closing


class Events(Closing):
    """An open file of events; raises ImportError without tensorboardX, and OSError.

    Invariants: an event is buffered whole or not at all, so a full disk leaves a file that reads.
    """

    def __init__(self, directory: Path) -> None:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.record_writer import masked_crc32c
        from tensorboardX.summary import scalar

        self._event, self._crc, self._scalar = Event, masked_crc32c, scalar
        directory.mkdir(exist_ok=True)
        name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
        self._file = (directory / name).open("wb")
        self._write(file_version="brain.Event:2")

    def add(self, tag: str, value: float, step: int) -> None:
        """Write one value."""
        self._write(step=step, summary=self._scalar(tag, value))

    def flush(self) -> None:
        """Hand what is written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Flush and close."""
        self._file.close()

    def _write(self, **event: Any) -> None:
        data = self._event(wall_time=time.time(), **event).SerializeToString()
        length = struct.pack("<Q", len(data))
        sums = [struct.pack("<I", self._crc(part)) for part in (length, data)]
        self._file.write(b"".join((length, sums[0], data, sums[1])))
