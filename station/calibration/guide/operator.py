"""The terminal of a calibration's operator, who may be alone in the booth."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import click

_BELL = "\a"
_LAST_SECONDS = 3
_LINE_EVERY_S = 5.0
_WIDTH = 100
_HEIGHT = click.FloatRange(0.0, 2.2)
"""Metres: within sight of a booth's cameras."""


@dataclass(slots=True)
class Guide:
    """Prompts, progress and sounds. Unattended (recordings, scripts) nothing is waited for."""

    attended: bool
    countdown_s: float
    _told_s: float = 0.0
    _open_line: bool = False

    def step(self, title: str, instruction: str) -> None:
        """Announce a step; wait until the operator is ready and in place."""
        self.title(title)
        click.echo(f"  {instruction}")
        if not self.attended:
            return
        click.prompt(
            f"  Enter starts a countdown of {self.countdown_s:g} s",
            default="", show_default=False, prompt_suffix=" ",
        )  # fmt: skip
        for left in range(int(self.countdown_s), 0, -1):
            bell = _BELL if left <= _LAST_SECONDS else ""
            self.progress(f"{left} ...{bell}", now=True)
            time.sleep(1.0)
        self.progress(f"now{_BELL}", now=True)

    def title(self, text: str) -> None:
        """Print the title of what begins now."""
        self.end_line()
        click.echo(f"\n{text}")

    def progress(self, text: str, *, now: bool = False) -> None:
        """One line that is written over; where no one watches, a new line now and then."""
        moment = time.monotonic()
        if sys.stdout.isatty():
            click.echo(f"\r  {text:<{_WIDTH}}"[: _WIDTH + 3], nl=False)
            self._open_line = True
        elif now or moment - self._told_s > _LINE_EVERY_S:
            self._told_s = moment
            click.echo(f"  {text}")

    def say(self, text: str) -> None:
        """A line that stays."""
        self.end_line()
        click.echo(f"  {text}")

    def done(self, text: str) -> None:
        """The step is over: the operator may move again."""
        self.say(f"{text}{_BELL if self.attended else ''}")

    def answers_yes(self, question: str) -> bool:
        """Ask whether the operator wants one more; no when nobody is there."""
        self.end_line()
        return self.attended and click.confirm(f"  {question}", default=True)

    def height_m(self) -> float | None:
        """The measured height of a stand, metres; None when there is none or nobody to ask."""
        self.end_line()
        if not self.attended:
            return None
        answer = click.prompt(
            "  A ball on a stand of measured height makes heights more accurate. Height of its "
            "underside above the floor in metres (0: no stand)",
            type=_HEIGHT,
            default=0.0,
        )
        return float(answer) or None

    def end_line(self) -> None:
        """End the progress line."""
        if self._open_line:
            click.echo()
            self._open_line = False
