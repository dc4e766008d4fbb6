"""Zenoh, and nothing else in the project imports it: sessions, publications, queries, presence."""

from common.transport.publications import LatestSubscriber, Presence, Publisher, QueueSubscriber
from common.transport.queries import Client, PendingReply, Request, Server
from common.transport.session import Session, free_endpoint

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
