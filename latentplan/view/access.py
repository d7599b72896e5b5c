"""Where the live view listens, and who may open it: this machine's own pages alone, or whoever has the token."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import SplitResult, parse_qs, urlsplit

from latentplan.config import UserError
from latentplan.config.checks import shown

PARAMETER = "token"


@dataclass(frozen=True)
class Access:
    """The rules of one live view.

    A view on the loopback interface has no token. It answers only requests for a loopback name, so that no other
    website reaches it under a name of its own (DNS rebinding). Every other view answers only requests with the token,
    in the address or in the cookie that the first answer sets. A websocket also needs an `Origin` of the view itself,
    because a browser lets every website open one.

    Attributes:
        port: Port of the view, which names its cookie: browsers send cookies to all ports of a host.
        token: The token; None on the loopback interface.
    """

    port: int
    token: str | None = None

    @classmethod
    def of(cls, host: str, port: int) -> Access:
        """The rules for an interface, with a new token where one is needed."""
        return cls(port, None if is_loopback(host) else secrets.token_urlsafe(32))

    @property
    def cookie(self) -> str:
        """Name of the cookie."""
        return f"latentplan-view-{self.port}"

    def refusal(self, headers: Mapping[str, str], query: str, *, is_socket: bool) -> str | None:
        """Why a request is refused; None where it is allowed.

        Args:
            headers: Headers of the request, with names in small letters.
            query: Query of its address.
            is_socket: Whether it opens a websocket.
        """
        host = headers.get("host", "")
        if self.token is None and not is_loopback(_split(f"//{host}").hostname or ""):
            return "this live view answers only to the names of this machine itself"
        if self.token is not None and not self._has_token(headers, query):
            return "this live view needs the token of the address that the program printed"
        if is_socket and _split(headers.get("origin", "")).netloc != host:
            return "another website may not open this live view"
        return None

    def brings_token(self, query: str) -> bool:
        """Whether the token stands in an address, from where a cookie takes it over."""
        return self.token is not None and self._is_token(_given(query))

    def _has_token(self, headers: Mapping[str, str], query: str) -> bool:
        # `http.cookies` drops every cookie beside one that it cannot read, and other programs of the host set cookies.
        cookies = [cookie.strip().partition("=") for cookie in headers.get("cookie", "").split(";")]
        kept = [value for name, _, value in cookies if name == self.cookie]
        return any(self._is_token(given) for given in (_given(query), *kept))

    def _is_token(self, given: str) -> bool:
        """Whether a text is the token, in a time that does not depend on the text."""
        return secrets.compare_digest(given.encode(), (self.token or "").encode()) and bool(self.token)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at an address.

    Args:
        host: Name or address of the interface.
        port: Port; 0 takes any free one.

    Raises:
        UserError: The address cannot be used.
    """
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, TypeError, ValueError) as error:
        reason = str(getattr(error, "strerror", None) or error).partition(" (while")[0]  # the address follows
        raise UserError(
            f"--host {shown(host)} --port {port} cannot be used: {reason}; --port 0 takes a free port"
        ) from None


def is_loopback(host: str) -> bool:
    """Whether a name or address is one that only this machine reaches."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _split(address: str) -> SplitResult:
    """The parts of an address; empty parts of one that is none."""
    try:
        return urlsplit(address)
    except ValueError:
        return urlsplit("")


def _given(query: str) -> str:
    return parse_qs(query).get(PARAMETER, [""])[0]
