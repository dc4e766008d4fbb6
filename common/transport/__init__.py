"""Zenoh, and nothing else in the project imports it: sessions, publications, queries, presence."""

from common.transport.publications import LatestSubscriber, Presence, Publisher, QueueSubscriber
from common.transport.queries import Client, PendingReply, Request, Server
from common.transport.refusals import Refusals
from common.transport.session import ROUTER_FILE, Session, free_endpoint

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
