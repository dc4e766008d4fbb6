"""Every error a caller may want to catch, drawn as one tree.

MrcdrlError
├── ConfigError         a setting is unknown, impossible or contradicts another
├── RunDirectoryError   a run's folder exists, is missing, or cannot be written
├── CheckpointError     weights or a checkpoint cannot be read, are foreign or damaged
├── DivergedError       learning led to numbers that are not finite: it would do so again
├── WireError           bytes from a peer break the wire's schema (counted and dropped)
└── TransportError      the network did not do what was asked
    ├── EndpointError   an endpoint cannot be listened on or connected to
    ├── DeadlineError   a wait ended; the message says whom it waited for
    ├── SharedMemoryError       memory that a peer lends is out of reach: the network must do
    └── RefusedError    the peer answered, and refused, with its reason
        └── ThrottledError   the peer's rate limiter held the request: try the same again
"""


class MrcdrlError(Exception):
    """Base of all errors raised on purpose; its text is one line, fit to be shown to a user."""

    exit_code = 1  # of a process that it ends


class ConfigError(MrcdrlError):
    """A setting is unknown, impossible or contradicts another."""


class RunDirectoryError(MrcdrlError):
    """A run's folder exists already, is missing, or cannot be written."""


class CheckpointError(MrcdrlError):
    """Weights or a checkpoint cannot be read, are foreign or damaged."""


class DivergedError(MrcdrlError):
    """Learning led to numbers that are not finite; a learner started again would diverge again."""

    exit_code = 3


class WireError(MrcdrlError):
    """Bytes from a peer break the wire's schema; the receiver counts and drops them."""


class TransportError(MrcdrlError):
    """The network did not do what was asked."""


class EndpointError(TransportError):
    """An endpoint cannot be listened on or connected to."""


class DeadlineError(TransportError):
    """A wait ended without an answer; the message says whom it waited for."""


class SharedMemoryError(TransportError):
    """Memory that a peer lends is out of reach; the message is the reason."""


class RefusedError(TransportError):
    """The peer answered and refused; the message is its reason."""


class ThrottledError(RefusedError):
    """The peer's rate limiter held the request for as long as it may; try the same again."""
