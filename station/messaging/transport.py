"""Sockets: local ipc with limits, timeouts and private files."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import zmq

from station.core.errors import BoothError
from station.core.files import PRIVATE_FILE_MODE, is_held, private_folder
from station.core.service import NOTHING_RUNS, STATION_LOCK, anything_runs
from station.messaging.messages import Reply, Request
from station.messaging.topics import TOPICS

_SCHEME = "ipc://"
_LONGEST_PATH = 100
"""The kernel allows 107 bytes for a socket's path."""
_SHORT = Path("/tmp")
"""The same for all: an operator's TMPDIR may be another than the station's."""
MAX_MESSAGE_BYTES = 16 << 20
_PATIENCE_S = 15.0
"""Within this a process that hangs is restarted."""


class NoAnswerError(BoothError):
    """A process did not answer in time; it may carry out the request anyway."""


class NothingRunsError(NoAnswerError):
    """No process of the booth runs: nobody received the request."""

    def __init__(self) -> None:
        super().__init__(NOTHING_RUNS)


def endpoint(runtime_folder: Path, name: str) -> str:
    """The ipc address of a named socket in the booth's runtime folder."""
    file = f"{name}.ipc"
    return f"{_SCHEME}{socket_folder(runtime_folder, file) / file}"


def socket_folder(runtime_folder: Path, longest: str) -> Path:
    """Folder of the sockets' files.

    A runtime folder whose path is too long for the longest file's name is replaced by a short
    private one derived from it.
    """
    folder = runtime_folder
    if len(str(folder / longest).encode()) > _LONGEST_PATH:
        digest = hashlib.sha256(str(runtime_folder).encode()).hexdigest()[:12]
        folder = _SHORT / f"booth-{os.getuid()}-{digest}"
    private_folder(folder)
    if folder.stat().st_uid != os.getuid():
        raise BoothError(f"{folder} belongs to another user; set runtime.folder in booth.toml")
    return folder


def _socket(context: zmq.Context[zmq.Socket[bytes]], kind: int, hwm: int) -> zmq.Socket[bytes]:
    socket = context.socket(kind)
    socket.set(zmq.LINGER, 0)
    socket.set(zmq.SNDHWM, hwm)
    socket.set(zmq.RCVHWM, hwm)
    socket.set(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    socket.set(zmq.SNDTIMEO, 1000)
    return socket


def publisher(
    context: zmq.Context[zmq.Socket[bytes]], runtime_folder: Path, name: str, topic: str
) -> zmq.Socket[bytes]:
    """A bound PUB socket, its file readable by the owner alone."""
    return _bound(context, zmq.PUB, runtime_folder, name, TOPICS[topic].high_water_mark)


def server(
    context: zmq.Context[zmq.Socket[bytes]], runtime_folder: Path, name: str
) -> zmq.Socket[bytes]:
    """A bound ROUTER socket for requests."""
    return _bound(context, zmq.ROUTER, runtime_folder, name, 64)


def dealer(
    context: zmq.Context[zmq.Socket[bytes]], runtime_folder: Path, name: str
) -> zmq.Socket[bytes]:
    """A socket that sends requests to a server without waiting for the answers."""
    socket = _socket(context, zmq.DEALER, 64)
    socket.connect(endpoint(runtime_folder, name))
    return socket


def _bound(
    context: zmq.Context[zmq.Socket[bytes]], kind: int, runtime_folder: Path, name: str, hwm: int
) -> zmq.Socket[bytes]:
    socket = _socket(context, kind, hwm)
    address = endpoint(runtime_folder, name)
    try:
        socket.bind(address)
        Path(address.removeprefix(_SCHEME)).chmod(PRIVATE_FILE_MODE)
    except (OSError, zmq.ZMQError):
        socket.close()
        raise
    return socket


def subscriber(
    context: zmq.Context[zmq.Socket[bytes]],
    runtime_folder: Path,
    names: list[str],
    topics: list[str],
) -> zmq.Socket[bytes]:
    """A SUB socket connected to publishers by name."""
    hwm = max(TOPICS[topic.split("/")[0]].high_water_mark for topic in topics)
    socket = _socket(context, zmq.SUB, hwm)
    for topic in topics:
        socket.subscribe(topic)
    for name in names:
        socket.connect(endpoint(runtime_folder, name))
    return socket


def ask(runtime_folder: Path, name: str, request: Request, timeout_s: float) -> Reply:
    """Send a request and wait for its reply; a process that is starting is waited for.

    Raises:
        NothingRunsError: at once, where no process of the booth runs.
        NoAnswerError: nobody answered in time.
    """
    address = endpoint(runtime_folder, name)
    if not anything_runs(runtime_folder):
        raise NothingRunsError
    with zmq.Context() as context, _socket(context, zmq.REQ, 4) as socket:
        socket.set(zmq.RCVTIMEO, int(1000 * timeout_s))
        socket.connect(address)
        try:
            socket.send(request.pack())
            return Reply.unpack(socket.recv())
        except zmq.Again:
            remedy = (
                "a process that hangs is restarted; try again in 15 s"
                if _is_running(runtime_folder, name)
                else "is it running? start it with: station run"
            )
            raise NoAnswerError(
                f"the station's {name} process did not answer within {timeout_s:g} s; {remedy}"
            ) from None


def ask_again(runtime_folder: Path, name: str, request: Request, timeout_s: float) -> Reply:
    """`ask` with a request that may be repeated: asked again while that process runs.

    Raises:
        NoAnswerError: nobody answered within `_PATIENCE_S`, or nobody is there to answer.
    """
    deadline_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return ask(runtime_folder, name, request, timeout_s)
        except NoAnswerError:
            if not _is_running(runtime_folder, name) or time.monotonic() > deadline_s:
                raise


def _is_running(runtime_folder: Path, name: str) -> bool:
    """Whether a process runs, or a supervisor that restarts it."""
    return any(is_held(runtime_folder / lock) for lock in (STATION_LOCK, f"{name}.lock"))
