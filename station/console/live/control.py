"""The operator's commands, sent as the `station` command sends them, with the same answers."""

from __future__ import annotations

from typing import Any

from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.messaging import asking
from station.messaging.messages import Request


class NotRunningError(BoothError):
    """No station is responding."""


def command(config: BoothConfig, request: Request) -> dict[str, Any]:
    """The reply of the control process.

    Raises:
        NotRunningError: no station responds.
        RefusedError: it refuses; the message says why and what to do.
    """
    try:
        return asking.command(config, request)
    except asking.RefusedError:
        raise
    except BoothError as error:
        raise NotRunningError(str(error)) from None
