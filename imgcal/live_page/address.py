"""The address of the page: this machine only, or any address, protected by a token."""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass

from imgcal.errors import InputError
from imgcal.messages import shorten

THIS_MACHINE, PORT = "127.0.0.1", 8765
TOKEN_BYTES, LEAST_TOKEN = 24, 16
WAITING = 128  # connections that may wait to be accepted


@dataclass(frozen=True)
class Address:
    """Host and port to listen on; port 0 takes any that is free."""

    host: str = THIS_MACHINE
    port: int = PORT

    @property
    def local(self) -> bool:
        """Tell whether only this machine can reach it."""
        return is_loopback(self.host)

    def url(self, token: str | None = None) -> str:
        """What to open in a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        if self.host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        return f"http://{host}:{self.port}/" + ("" if token is None else f"?token={token}")

    def listen(self) -> socket.socket:
        """Open the socket.

        Raises:
            InputError: the address is taken, or is none of this machine's.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((self.host, self.port))
            listening.listen(WAITING)
        except OSError as error:
            listening.close()
            reason = error.strerror or str(error)
            raise InputError(
                f"{self.host}:{self.port}: {reason}, expected an address of this machine that is free"
            ) from error
        return listening


def parse_address(text: str | None, option: str = "--serve", usual: int | None = PORT) -> Address:
    """Read `HOST:PORT`, `HOST`, `:PORT` or `PORT`; None = this machine.

    Args:
        text: what was given.
        option: for the message.
        usual: port if none is given; None = one must be given.

    Raises:
        InputError: something else.

    Examples:
        >>> parse_address("0.0.0.0:9000"), parse_address("9000").host, parse_address("[::1]").local
        (Address(host='0.0.0.0', port=9000), '127.0.0.1', True)
    """
    given = text or ""
    match = re.fullmatch(r"(?:(?P<only>\d+)|(?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]*)(?::(?P<port>\d{1,5}))?)", given)
    port = (match["only"] or match["port"] or usual) if match else None
    if match is None or port is None or int(port) > 65535 or not is_host(match["host"] or THIS_MACHINE):
        raise InputError(f"{option}: found {shorten(given)!r}, expected [HOST:]PORT, such as {THIS_MACHINE}:{PORT}")
    return Address((match["host"] or THIS_MACHINE).strip("[]"), int(port))


def is_host(text: str) -> bool:
    """Tell whether a text may be an address or the name of a machine: names have no empty or very long parts."""
    try:
        return bool(text.encode("idna"))
    except UnicodeError:
        return False


def is_loopback(host: str) -> bool:
    """Tell whether a host is this machine, for itself alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_token(token: str | None) -> str:
    """Make a token, or check one that was given.

    Raises:
        InputError: one that is short, or does not fit into an address.
    """
    if token is None:
        return secrets.token_urlsafe(TOKEN_BYTES)
    if not re.fullmatch(rf"[\w-]{{{LEAST_TOKEN},128}}", token, re.ASCII):
        raise InputError(f"token: found {len(token)} characters, expected {LEAST_TOKEN} to 128 of A-Z a-z 0-9 _ -")
    return token
