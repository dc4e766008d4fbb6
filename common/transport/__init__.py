"""Zenoh, and nothing else in the project imports it: sessions, publications, queries, presence."""

from common.transport.session import (
    Client,
    LatestSubscriber,
    PendingReply,
    Presence,
    Publisher,
    QueueSubscriber,
    Request,
    Server,
    Session,
    free_endpoint,
)

__all__ = [
    "Client",
    "LatestSubscriber",
    "PendingReply",
    "Presence",
    "Publisher",
    "QueueSubscriber",
    "Request",
    "Server",
    "Session",
    "free_endpoint",
]
