"""Tasks longer than a request: a calibration step, a check of the cameras. One at a time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import IO, Any

from station.console.live.events import EventLog
from station.core.service import die_with_parent
from station.messaging.asking import RefusedError

_LINES_KEPT = 60
_COMPLAINT_BYTES = 1 << 16
_EXITS_OF_A_CHECK = (0, 3, 4)
"""No camera has moved; one has; the booth looks too different to tell."""
_ANSWERS = {"go": ("go",), "yes or no": ("yes", "no"), "height": ("no",)}
"""Kind of question -> the words that answer it; a height is answered by a number, too."""
_Started = Future[subprocess.Popen[str]]


class Tasks:
    """The current task, or the last one."""

    def __init__(self, config_path: Path, events: EventLog) -> None:
        self._config_path, self._events = config_path, events
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._state = _idle()

    def state(self) -> dict[str, Any]:
        """The current task, its messages, the answer that it is waiting for."""
        with self._lock:
            return {**self._state, "lines": list(self._state["lines"])}

    def calibrate(self, step: str, new: bool) -> dict[str, Any]:
        """Start a step of the calibration, or all.

        Raises:
            RefusedError: another task is running.
        """
        module = [sys.executable, "-m", "station.console.live.guided"]
        words = [str(self._config_path), step, *(["new"] if new else [])]
        return self._begin("calibrate", step, [*module, *words])

    def check(self) -> dict[str, Any]:
        """Compare the empty booth with what was stored when it was calibrated.

        Raises:
            RefusedError: another task is running.
        """
        option = ["--config", str(self._config_path)]
        return self._begin(
            "check", "", [sys.executable, "-m", "station.cli", "check", "--json", *option]
        )

    def answer(self, word: str) -> dict[str, Any]:
        """Pass on the operator's answer to the running task: "go", "yes", "no", or metres.

        Raises:
            RefusedError: it is not waiting for this answer.
        """
        with self._lock:
            process, asked = self._process, self._state["waits_for"]
            if process is None or process.stdin is None or not asked:
                raise RefusedError("nothing is waiting for an answer")
            known = ("go", "yes", "no")
            if word not in _ANSWERS[asked] and (asked != "height" or word in known):
                raise RefusedError(f"this is no answer to the question; it asks for: {asked}")
            self._state["waits_for"] = ""
            try:
                process.stdin.write(f"{word}\n")
                process.stdin.flush()
            except BrokenPipeError:
                raise RefusedError("nothing is waiting for an answer") from None
        return self.state()

    def stop(self) -> dict[str, Any]:
        """End the running task as Ctrl-C does; recorded data are kept."""
        with self._lock:
            if self._process is not None:
                self._process.send_signal(signal.SIGINT)
        return self.state()

    def close(self) -> None:
        with self._lock:
            if self._process is not None:
                self._process.terminate()

    def _begin(self, kind: str, step: str, command: list[str]) -> dict[str, Any]:
        with self._lock:
            if self._process is not None:
                raise RefusedError(f"{self._state['kind']} is in progress; wait for it, or stop it")
            # The process ends with the thread that starts it, and a request's ends soon.
            started = _Started()
            threading.Thread(target=self._run, args=(command, started), daemon=True).start()
            self._process = started.result()
            self._state = {**_idle(), "kind": kind, "step": step, "running": True}
        self._tell()
        return self.state()

    def _run(self, command: list[str], started: _Started) -> None:
        with ExitStack() as stack:
            try:
                # A file takes whatever the process complains of; a full pipe would stop it.
                errors = stack.enter_context(tempfile.TemporaryFile())
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                    errors="replace",
                    preexec_fn=partial(die_with_parent, os.getpid()),
                )
            except BaseException as error:
                # Whoever waits for the process waits for ever otherwise.
                started.set_exception(error)
                return
            started.set_result(process)
            self._read(process)
            code = process.wait()
            self._end(code, _last_line(errors))

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            try:
                said = json.loads(line)
            except ValueError:
                continue
            if isinstance(said, dict):
                self._handle(said)

    def _end(self, code: int, complaint: str) -> None:
        with self._lock:
            self._process = None
            if complaint and code not in _EXITS_OF_A_CHECK:
                self._state["error"] = complaint.removeprefix("error: ")
            self._state |= {"running": False, "waits_for": "", "countdown_s": None}
        self._tell()

    def _handle(self, said: dict[str, Any]) -> None:
        """One line of the guide."""
        text = str(said.get("text", ""))
        with self._lock:
            state = self._state
            match said.get("kind"):
                case "step":
                    state |= {"title": said["title"], "instruction": text}
                    state |= {"progress": "", "question": "", "step_lines": 0}
                    state["waits_for"] = "go" if said.get("waits") else ""
                case "countdown":
                    state["countdown_s"] = said["left_s"] or None
                case "progress":
                    state["progress"] = text
                case "question":
                    state |= {"question": text, "waits_for": "yes or no"}
                case "height":
                    state |= {"question": text, "waits_for": "height"}
                case "line" | "done":
                    state["lines"] = [*state["lines"], text][-_LINES_KEPT:]
                    state["step_lines"] = min(state["step_lines"] + 1, _LINES_KEPT)
                case "error":
                    state["error"] = text
        self._tell()

    def _tell(self) -> None:
        self._events.append("calibration", self.state())


def _last_line(errors: IO[bytes]) -> str:
    """The last line of what a process complained of; empty if it did not."""
    errors.seek(max(0, errors.seek(0, os.SEEK_END) - _COMPLAINT_BYTES))
    lines = errors.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def _idle() -> dict[str, Any]:
    return {
        "kind": "", "step": "", "running": False, "title": "", "instruction": "", "progress": "",
        "question": "", "waits_for": "", "countdown_s": None, "lines": [], "step_lines": 0,
        "error": "",
    }  # fmt: skip
