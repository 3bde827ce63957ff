"""Access control of a monitor page: known hosts, the page's own origin, and a token where there is one.

A browser on this machine also shows pages of others. They must not read the run: by a name of theirs that
resolves to this machine (DNS rebinding), by a WebSocket, or by a form that is sent here.
"""

import hashlib
import hmac
import socket
from ipaddress import ip_address
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler


class Access:
    """Access control of the page; without a `token` every request to `host` is answered."""

    def __init__(self, host: str, token: str | None) -> None:
        self._token = token
        self._hosts = {host, "localhost", socket.gethostname().lower()}

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse what comes from elsewhere, and what brings no token; a token by address becomes a cookie."""
        if not self.knows_host(request.host):
            raise web.HTTPForbidden(text="Host: this page has another name; open it by its address")
        origin = request.headers.get("Origin")
        if origin is None:
            if request.method not in ("GET", "HEAD"):
                raise web.HTTPForbidden(text="Origin: missing; only the page itself may do this")
        elif not is_same_origin(origin, request.host):
            raise web.HTTPForbidden(text="Origin: another page's")
        if self._token is None:
            return await handler(request)
        brought = request.query.get("token")
        if brought is not None and _same(brought, self._token):
            response = await handler(request)
            if not response.prepared:
                self._give_cookie(request, response)
            return response
        if not self._is_authorized(request):
            raise web.HTTPUnauthorized(
                text="A token is needed: open the page with ?token=… once, "
                "or send the header Authorization: Bearer …",
                headers={"WWW-Authenticate": "Bearer"},
            )
        return await handler(request)

    def knows_host(self, host: str) -> bool:
        """Return whether a request's host is this machine: an address, or the machine's name."""
        name = (urlsplit(f"//{host}").hostname or "").lower()
        try:
            ip_address(name)
        except ValueError:
            return name.removesuffix(".local") in self._hosts
        return True

    def _is_authorized(self, request: web.Request) -> bool:
        assert self._token is not None
        scheme, _, brought = request.headers.get("Authorization", "").partition(" ")
        if scheme == "Bearer" and _same(brought, self._token):
            return True
        return _same(request.cookies.get(_cookie_name(request), ""), _cookie_of(self._token))

    def _give_cookie(self, request: web.Request, response: web.StreamResponse) -> None:
        assert self._token is not None
        response.set_cookie(
            _cookie_name(request),
            _cookie_of(self._token),
            max_age=365 * 86_400,
            httponly=True,
            samesite="Strict",
            secure=request.secure,
        )


def is_same_origin(origin: str, host: str) -> bool:
    """Return whether a request's origin is a page of the requested host."""
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and parts.netloc == host


def _cookie_name(request: web.Request) -> str:
    """Return a name of this port's own: cookies are shared by all ports of a host."""
    return f"arctrack_monitor_{urlsplit(f'//{request.host}').port or 80}"


def _cookie_of(token: str) -> str:
    """Return what a browser keeps: not the token itself, and the same after a restart."""
    return hmac.new(token.encode(), b"arctrack monitor page", hashlib.sha256).hexdigest()


def _same(brought: str, secret: str) -> bool:
    return hmac.compare_digest(brought.encode("utf-8", "replace"), secret.encode())
