"""The priority of messages that share a session."""

from enum import Enum

import zenoh


class Priority(Enum):
    """A message waits for those of its own priority and above that are on the way to the same peer.

    So the acknowledgement of a chunk need not wait for weights, a thousand times its size.
    """

    HIGH = zenoh.Priority.DATA_HIGH
    """Small and due: statistics, episodes, leases."""
    NORMAL = zenoh.Priority.DATA
    """Chunks, samples, their acknowledgements, the configuration."""
    LOW = zenoh.Priority.DATA_LOW
    """Weights."""
