"""Requests to the booth's control process."""

from __future__ import annotations

from typing import Any

from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.messaging.messages import Request
from station.messaging.transport import ask, ask_again

STARTS = "the booth is starting; try again in a few seconds"


class RefusedError(BoothError):
    """The station responds, and refuses."""


def command(config: BoothConfig, request: Request, *, repeats: bool = False) -> dict[str, Any]:
    """Content of control's reply.

    Args:
        repeats: the request may be received twice.

    Raises:
        NoAnswerError: control did not answer.
        RefusedError: it refuses; the message says why and what to do.
    """
    runtime = config.runtime
    asked = ask_again if repeats else ask
    reply = asked(runtime.folder, "control", request, runtime.command_timeout_s)
    if not reply.ok:
        raise RefusedError(reply.error)
    return reply.content
