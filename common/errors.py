"""The errors that a caller may want to catch, as one tree.

MrcdrlError
├── ConfigError         a setting is unknown, impossible or contradicts another
├── RunDirectoryError   a run directory exists, is missing, or cannot be written
├── CheckpointError     weights or a checkpoint are unreadable, damaged or of another network
├── NameTakenError      another process of the run has this worker's name, or its task
├── DivergedError       learning produced numbers that are not finite, and would again
├── WireError           bytes from a peer break the wire's schema (counted and dropped)
└── TransportError      the network failed to do what was asked
    ├── EndpointError   an endpoint cannot be listened on or connected to
    │   └── UnreachableError  nobody answers there, or no run is up to name one
    ├── DeadlineError   a wait timed out; the message names the peer
    ├── SharedMemoryError  a peer's shared buffer is out of reach; the network serves instead
    └── RefusedError    the peer refused, and gave its reason
        └── ThrottledError  the peer cannot serve the request now; send it again
"""


class MrcdrlError(Exception):
    """Base of all errors raised on purpose; the message is one line, fit for a user."""

    exit_code = 1  # of the process that it ends


class ConfigError(MrcdrlError):
    """A setting is unknown, impossible or contradicts another."""

    exit_code = 2


class RunDirectoryError(MrcdrlError):
    """A run directory exists already, is missing, or cannot be written."""


class CheckpointError(MrcdrlError):
    """Weights or a checkpoint are unreadable, damaged or of another network."""


class NameTakenError(MrcdrlError):
    """Another process of the run has this worker's name, or the task that only one may have."""


class DivergedError(MrcdrlError):
    """Learning produced numbers that are not finite; a restarted learner would diverge again."""

    exit_code = 3


class WireError(MrcdrlError):
    """Bytes from a peer break the wire's schema; the receiver counts and drops them."""


class TransportError(MrcdrlError):
    """The network failed to do what was asked."""


class EndpointError(TransportError):
    """An endpoint cannot be listened on or connected to."""


class UnreachableError(EndpointError):
    """Nobody answers at an endpoint, or no run is up that would name one."""


class DeadlineError(TransportError):
    """A wait timed out without an answer; the message names the peer."""


class SharedMemoryError(TransportError):
    """A peer's shared buffer is out of reach; the message is the reason."""


class RefusedError(TransportError):
    """The peer refused; the message is its reason."""


class ThrottledError(RefusedError):
    """The peer cannot serve the request now; send it again.

    The message says why: the rate limiter, a full queue, a log that cannot be written, no weights
    yet, or a shared buffer that the peer cannot open.
    """
