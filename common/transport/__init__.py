"""Zenoh, and nothing else in the project imports it: sessions, publications, queries, presence."""

from mrcdrl.common.transport.access_log import Refusals
from mrcdrl.common.transport.publications import (
    LatestSubscriber,
    Presence,
    Publisher,
    QueueSubscriber,
)
from mrcdrl.common.transport.queries import Client, PendingReply, Request, Server
from mrcdrl.common.transport.session import ROUTER_FILE, Session, free_endpoint

__all__ = [
    "ROUTER_FILE",
    "Client",
    "LatestSubscriber",
    "PendingReply",
    "Presence",
    "Publisher",
    "QueueSubscriber",
    "Refusals",
    "Request",
    "Server",
    "Session",
    "free_endpoint",
]
