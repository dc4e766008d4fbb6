"""The transport over Zenoh, which nothing else imports: sessions, publications, queries."""

from mrcdrl.common.transport.access_log import AccessLog
from mrcdrl.common.transport.priority import Priority
from mrcdrl.common.transport.publications import (
    LatestSubscriber,
    Presence,
    Publisher,
    QueueSubscriber,
    WatchedPublisher,
)
from mrcdrl.common.transport.queries import Client, PendingReply, Request, Server
from mrcdrl.common.transport.session import ROUTER_FILE, Session, free_endpoint

__all__ = [
    "ROUTER_FILE",
    "AccessLog",
    "Client",
    "LatestSubscriber",
    "PendingReply",
    "Presence",
    "Priority",
    "Publisher",
    "QueueSubscriber",
    "Request",
    "Server",
    "Session",
    "WatchedPublisher",
    "free_endpoint",
]
