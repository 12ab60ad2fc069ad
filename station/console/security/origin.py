"""Whether a request comes from the console's own page. Pure.

A page of another site may send requests here with the operator's cookie (cross-site request
forgery), and a site whose name is made to point at this address may read the answers (DNS
rebinding). The first is recognised by its Origin header, the second by its Host header.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection
from urllib.parse import urlsplit


def own_names(names: Collection[str]) -> frozenset[str]:
    """Names by which browsers may reach this host."""
    host = socket.gethostname().lower()
    return frozenset({"localhost", host, f"{host}.local", *(name.lower() for name in names)})


def host_allowed(host: str, names: Collection[str]) -> bool:
    """Whether a Host header is one of the console's; a numeric address does not depend on a name
    service, so it is safe."""
    name = _hostname(f"//{host}")
    if name is None:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name in names
    return True


def same_origin(origin: str, host: str, scheme: str) -> bool:
    """Whether an Origin header names the address that the request was sent to."""
    try:
        parts = urlsplit(origin)
        return parts.scheme == scheme and parts.netloc.lower() == host.lower() and bool(host)
    except ValueError:
        return False


def _hostname(url: str) -> str | None:
    try:
        parts = urlsplit(url)
        _ = parts.port
        return parts.hostname if "@" not in parts.netloc else None
    except ValueError:
        return None
