"""Access control: pages of this machine, and requests with the token. Nothing here reads a file.

A page of another origin may send requests to this address, also under another name that it has let point here
(DNS rebinding). So only names of this machine, or plain addresses, which cannot be rebound; only our own origin;
commands only with the token, which no other page can read.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs

from imgcal.live_page.address import Address, is_loopback

HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Of every answer; the page itself adds its Content-Security-Policy."""
TOKEN_HEADER = "x-imgcal-token"


@dataclass(frozen=True)
class Refusal:
    """The reason for not serving a request."""

    status: int
    reason: str


@dataclass(frozen=True)
class Gate:
    """Decides about requests by their headers alone."""

    address: Address
    token: str

    @property
    def cookie(self) -> str:
        """Name of the cookie; servers at other ports of this host have their own."""
        return f"imgcal-{self.address.port}"

    def refusal(self, method: str, path: str, headers: Mapping[str, list[str]]) -> Refusal | None:
        """Judge a request; None = it may pass.

        Args:
            method: of HTTP.
            path: without the query.
            headers: all values of each name, in lower case.
        """
        hosts = headers.get("host", [])
        if len(hosts) != 1 or not self.knows(hosts[0]):
            return Refusal(421, "this is not the server of that name")
        if method not in ("GET", "HEAD", "POST"):
            return Refusal(405, "expected GET or POST")
        origins, sites = headers.get("origin", []), headers.get("sec-fetch-site", [])
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return Refusal(403, "the request comes from another site")
        opened = method == "GET" and path == "/" and headers.get("sec-fetch-mode") == ["navigate"]
        if any(site not in ("same-origin", "none") for site in sites) and not opened:
            return Refusal(403, "the request comes from another site")
        if method == "POST" and not self._matches(headers.get(TOKEN_HEADER, [])):
            return Refusal(403, "expected the token of this page")
        if not self.address.local and not self._is_known(headers):
            return Refusal(401, "expected the token: open the address that was printed where imgcal was started")
        return None

    def knows(self, host: str) -> bool:
        """Tell whether a Host header names this server, by a name or address that no other site can have."""
        match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::\d{1,5})?", host.lower())
        if match is None:
            return False
        name = match[1].strip("[]")
        if self.address.local:
            return is_loopback(name)
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in {"localhost", self.address.host.lower(), socket.gethostname().lower()}
        return True

    def is_token(self, given: str) -> bool:
        """Compare in constant time."""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def token_of_query(self, query: str) -> bool:
        """Tell whether a query has the token."""
        try:
            return self._matches(parse_qs(query, max_num_fields=8).get("token", []))
        except ValueError:
            return False

    def _is_known(self, headers: Mapping[str, list[str]]) -> bool:
        given = [value.removeprefix("Bearer ") for value in headers.get("authorization", [])]
        # Not by http.cookies: it discards them all where another server's cookie has an unusual value.
        pairs = (pair.strip().partition("=") for value in headers.get("cookie", []) for pair in value.split(";"))
        given += [value for name, _, value in pairs if name == self.cookie]
        return self._matches(given[:1]) or self._matches(headers.get(TOKEN_HEADER, []))

    def _matches(self, given: list[str]) -> bool:
        return len(given) == 1 and self.is_token(given[0])


class Allowance:
    """A rate limit: so many at once, so many a second."""

    def __init__(self, burst: int, each_second: float) -> None:
        """Begin with all of the burst."""
        self._burst, self._each_second = burst, each_second
        self._left, self._at = float(burst), time.monotonic()

    def try_take(self) -> bool:
        """Take one, if there is one."""
        now = time.monotonic()
        self._left = min(self._left + (now - self._at) * self._each_second, self._burst)
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
