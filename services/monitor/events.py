"""TensorBoard events, written by whoever records them.

tensorboardX's own writer hands them to a thread. When the disk is full that thread ends, and ten
events later its caller waits without end.
"""

import os
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from mrcdrl.common.runtime.closing import Closing

_SIZES = {b"\x89PNG": (">II", 16), b"GIF8": ("<HH", 6)}  # where pictures tell width and height


class Events(Closing):
    """An open file of events; raises ImportError without tensorboardX, and OSError.

    Invariants: an event is buffered whole or not at all, so a full disk leaves a file that reads.
    """

    def __init__(self, directory: Path) -> None:
        from tensorboardX import summary
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.record_writer import masked_crc32c

        self._event, self._crc, self._summary = Event, masked_crc32c, summary
        directory.mkdir(exist_ok=True)
        name = f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
        self._file = (directory / name).open("wb")
        self._write(file_version="brain.Event:2")

    def add(self, tag: str, value: float, step: int) -> None:
        """Write one value."""
        self._write(step=step, summary=self._summary.scalar(tag, value))

    def add_histogram(
        self,
        tag: str,
        edges: Sequence[float],
        shares: Sequence[float],
        span: tuple[float, float],
        step: int,
    ) -> None:
        """Write a histogram.

        edges: between the bins, rising; span: the least and the greatest value, which bound the
        outer bins. shares: of the values in each bin, one more than edges.
        """
        low, high = min(span[0], edges[0]), max(span[1], edges[-1])
        ends = [low, *edges, high]
        middles = [(left + right) / 2 for left, right in pairwise(ends)]
        total = sum(share * middle for share, middle in zip(shares, middles, strict=True))
        squares = sum(share * middle**2 for share, middle in zip(shares, middles, strict=True))
        made = self._summary.histogram_raw(
            tag, low, high, sum(shares), total, squares, ends[1:], list(shares)
        )
        self._write(step=step, summary=made)

    def add_text(self, tag: str, text: str, step: int = 0) -> None:
        """Write a text in Markdown."""
        self._write(step=step, summary=self._summary.text(tag, text))

    def add_hyperparameters(self, given: Mapping[str, float | str], reached: Sequence[str]) -> None:
        """Write what a run was made with; reached: tags of the values by which it is compared."""
        for made in self._summary.hparams(dict(given), dict.fromkeys(reached, 0.0))[:2]:
            self._write(summary=made)

    def add_picture(self, tag: str, encoded: bytes, step: int) -> None:
        """Write a PNG or a GIF, which moves; raises ValueError for anything else."""
        if encoded[:4] not in _SIZES:
            raise ValueError(f"{tag} is neither a PNG nor a GIF")
        layout, offset = _SIZES[encoded[:4]]
        width, height = struct.unpack_from(layout, encoded, offset)
        summary = self._summary.Summary
        image = summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=encoded
        )
        self._write(step=step, summary=summary(value=[summary.Value(tag=tag, image=image)]))

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
