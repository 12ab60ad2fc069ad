"""The operator's commands, sent as the `station` command sends them, with the same answers."""

from __future__ import annotations

from typing import Any

from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.messaging.messages import Request
from station.messaging.transport import ask


class NotRunningError(BoothError):
    """No station is responding."""


class RefusedError(BoothError):
    """The station responds, and refuses."""


def command(config: BoothConfig, request: Request) -> dict[str, Any]:
    """The reply of the control process.

    Raises:
        NotRunningError: no station responds.
        RefusedError: it refuses; the message says why and what to do.
    """
    try:
        reply = ask(config.runtime.folder, "control", request, config.runtime.command_timeout_s)
    except BoothError as error:
        raise NotRunningError(str(error)) from None
    if not reply.ok:
        raise RefusedError(reply.error)
    return reply.content
