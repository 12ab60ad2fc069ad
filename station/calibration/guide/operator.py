"""The terminal of a calibration's operator, who may be alone in the booth."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import click

from station.core.commands import Number

_BELL = "\a"
_LAST_SECONDS = 3
_LINE_EVERY_S = 5.0
_WIDTH = 100
_HEIGHT = Number(0.0, unit="metres")


@dataclass(slots=True)
class Guide:
    """Prompts, progress and sounds. Unattended (recordings, scripts) nothing is waited for."""

    attended: bool
    countdown_s: float
    """To walk into the booth, lay the ball down and step back; a walk alone takes half of it."""
    _explained: bool = False
    _told_s: float = 0.0
    _untold: str = ""
    _open_line: bool = False

    def step(self, title: str, instruction: str = "", *, lays: bool = False) -> None:
        """Announce a step; wait until the operator is ready and in place.

        ``lays``: the operator has something to lay down there, after the walk.
        """
        self.title(title)
        if instruction:
            click.echo(f"  {instruction}")
        if not self.attended:
            return
        seconds = self._seconds(lays)
        words = f"({seconds} s)" if self._explained else f"starts a countdown of {seconds} s"
        self._explained = True
        click.prompt(f"  Enter {words}", default="", show_default=False, prompt_suffix=" ")
        self.count_down(lays=lays)

    def count_down(self, *, lays: bool = False) -> None:
        """Count the seconds until the operator is in place; nothing when nobody is there."""
        for left in range(self._seconds(lays) if self.attended else 0, 0, -1):
            self._tick(left)
            time.sleep(1.0)
        if self.attended:
            self._tick(0)

    def _seconds(self, lays: bool) -> int:
        return int(self.countdown_s if lays else 0.5 * self.countdown_s)

    def _tick(self, left: int) -> None:
        words = f"{left} ..." if left else "now"
        self.progress(f"{words}{_BELL if left <= _LAST_SECONDS else ''}", now=True)

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
            self._told_s, self._untold = moment, ""
            click.echo(f"  {text}")
        else:
            self._untold = text

    def say(self, text: str) -> None:
        """A line that stays."""
        self.end_line()
        click.echo(f"  {text}")

    def done(self, text: str) -> None:
        """The step is over: the operator may move again."""
        self.say(f"{text}{_BELL if self.attended else ''}")

    def answers_yes(self, question: str, *, usual: bool = True) -> bool:
        """Ask the operator, whose Enter alone is the usual answer; no when nobody is there."""
        self.end_line()
        return self.attended and click.confirm(f"  {question}", default=usual)

    def height_m(self, question: str) -> float | None:
        """The measured height of the ball, metres; None when there is none or nobody to ask."""
        self.end_line()
        if not self.attended:
            return None
        answer = click.prompt(f"  {question} Metres (0: leave out)", type=_HEIGHT)
        return float(answer) or None

    def end_line(self) -> None:
        """End the progress; its last line is printed, whenever it came."""
        if self._untold:
            click.echo(f"  {self._untold}")
            self._untold = ""
        if self._open_line:
            click.echo()
            self._open_line = False
