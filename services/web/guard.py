"""What every request has to pass, and every answer says, before and after the pages themselves.

Invariants: only GET and HEAD reach a page, and POST from the page itself where something can be
changed; a request for another host, or from another site, does not; where there is a token, nothing
is told to who does not have it. No answer allows another site to read it.
"""

import hmac
import ipaddress
import socket
from collections.abc import Collection, Iterable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from mrcdrl.common.runtime.hosts import host_of

_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "media-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_WEEK_S = 7 * 86_400


class Guard:
    """The outermost application: checks each request, and adds headers to each answer."""

    def __init__(
        self, app: ASGIApp, hosts: Iterable[str], token: str | None, changes: Collection[str] = ()
    ) -> None:
        """hosts: names by which this server is reached besides its addresses and `localhost`.

        token: asked for if there is one, once in the address and then by a cookie. changes: paths
        that take POST, with JSON only: a form of another site cannot send that.
        """
        self._changes = frozenset(changes)
        self._app = app
        self._hosts = frozenset({"localhost", socket.gethostname().lower(), *hosts})
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        answer = self._refusal(scope)
        await (answer or self._app)(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> Response | None:
        """What to answer instead of the page; None if the request may pass."""
        headers = Headers(scope=scope)
        if not self._is_this_host(headers.get("host", "")):
            return _said(421, "this address is not one of this server's")
        changes = scope["path"] in self._changes
        if scope["method"] not in (("POST",) if changes else ("GET", "HEAD")):
            allowed = "POST" if changes else "GET, HEAD"
            return _said(405, f"only {allowed}", {"Allow": allowed})
        if changes and headers.get("content-type") != "application/json":
            return _said(415, "send application/json")
        elsewhere = headers.get("sec-fetch-site") == "cross-site"
        if elsewhere and headers.get("sec-fetch-mode") != "navigate":
            return _said(403, "another site may not read this one")
        return self._ask_for_token(scope, headers) if self._token else None

    def _is_this_host(self, host: str) -> bool:
        """Whether a Host header names this server: a name that it has, or any address.

        A page elsewhere whose name is made to mean this machine (DNS rebinding) comes with its own
        name, and never with an address.
        """
        name = host_of(host).removesuffix(".")
        return name in self._hosts or _is_address(name.removeprefix("[").removesuffix("]"))

    def _ask_for_token(self, scope: Scope, headers: Headers) -> Response | None:
        query = parse_qsl(scope["query_string"].decode("latin-1"))
        cookie = f"mrcdrl-token-{(scope.get('server') or ('', 0))[1]}"
        given = dict(query).get("token")
        if given is not None and self._is_token(given):
            others = urlencode([pair for pair in query if pair[0] != "token"])
            answer = RedirectResponse(scope["path"] + f"?{others}" * bool(others), 303)
            secure = scope["scheme"] == "https"
            answer.set_cookie(
                cookie, given, _WEEK_S, httponly=True, samesite="strict", secure=secure
            )
            return answer
        kept = _cookies(headers.get("cookie", "")).get(cookie, "")
        bearer = headers.get("authorization", "").removeprefix("Bearer ")
        if self._is_token(kept) or self._is_token(bearer):
            return None
        return _said(401, "add ?token=… to the address, as `mrcdrl web` printed or was given it")

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), (self._token or "").encode())


def _cookies(header: str) -> dict[str, str]:
    try:
        return {name: morsel.value for name, morsel in SimpleCookie(header).items()}
    except CookieError:
        return {}


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _said(code: int, text: str, headers: dict[str, str] | None = None) -> Response:
    return PlainTextResponse(f"{text}\n", code, headers)
