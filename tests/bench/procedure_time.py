"""Duration of a calibration for one person, added up over the steps of the real guide.

The guide runs with everything that it asks for, and with nobody: each prompt is charged with
reading and walking, each step with what has to be carried and with what the cameras look at. Times
of people are the constants below, not measurements; everything else is the product's own.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain, repeat
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

from station.calibration.detect.step_names import EMPTY, HANGING, RAISED
from station.calibration.detect.swing import LOOK_S
from station.calibration.guide import attempt, steps
from station.calibration.guide import procedure as guided
from station.calibration.guide.operator import Guide
from station.calibration.guide.procedure import Procedure
from station.core.config import CalibrateConfig
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.simulation.procedure import VirtualProcedure
from station.simulation.sensor import FRAME_RATE_HZ

BAR_S = 360.0
SOLVING_S = 20.0
"""The bar of the solution; `bench_violations` prints what it takes."""
_HEIGHT_CHECK_S = 1.0
"""First poses of the cameras, which tell a wrong height; 0.6 s for 1,300 detections."""
_WORDS_A_S = 4.0
"""Silent reading (Brysbaert 2019: 238 words a minute)."""
_WALK_S = 4.0
"""From the mark to the keyboard, 4 m; the way back is within the countdown."""
_ANSWER_S = 2.0
_FETCH_S = {"stand": 15.0, "hook": 20.0, "board": 10.0}
"""To put up the stand, to hang the ball (it comes to rest meanwhile, and on the way back), or to
move the board; the ball is laid in the countdown."""


class _NoFeed:
    """No cameras: looks take their nominal times."""

    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> tuple[None, SimpleNamespace]:
        return None, SimpleNamespace(
            balls=(), raised=[], raised_as=lambda _: {}, record_resting=lambda *_: None
        )

    def __exit__(self, *_: object) -> None:
        pass


@dataclass(slots=True)
class Operator:
    """Somebody who reads everything and does all that is wanted."""

    raised_m: list[float]
    boards: int
    hangs: bool
    spent_s: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def read(self, text: str, **_: object) -> None:
        self.spent_s["reading"] += len(text.split()) / _WORDS_A_S

    def prompt(self, text: str, **_: object) -> float | str:
        """Enter before a step, or the height of the ball."""
        self.read(text)
        if "Enter" in text:
            self.spent_s["walking to the keyboard"] += _WALK_S
            return ""
        if not self.raised_m:
            self.spent_s["answers"] += _ANSWER_S
            return 0.0
        self._fetch("hook" if self.hangs else "stand")
        return self.raised_m.pop(0)

    def confirm(self, text: str, **_: object) -> bool:
        """Is the board there, or does the ball hang?"""
        self.read(text)
        if "hang" in text:
            self.spent_s["answers"] += _ANSWER_S
            return self.hangs
        self.boards -= 1
        if self.boards >= 0:
            self._fetch("board")
        else:
            self.spent_s["answers"] += _ANSWER_S
        return self.boards >= 0

    def _fetch(self, what: str) -> None:
        """Put it up, come back to the keyboard and say so."""
        self.spent_s["ball and board"] += _FETCH_S[what]
        self.spent_s["walking to the keyboard"] += _WALK_S
        self.spent_s["answers"] += _ANSWER_S

    def wait(self, seconds: float) -> None:
        self.spent_s["countdowns"] += seconds

    def look(self, seconds: float) -> Callable[..., None]:
        """A step of the cameras that takes so long."""

        def looked(*_: object, **__: object) -> None:
            self.spent_s["looking and waving"] += seconds

        return looked


def procedure_seconds(*, extras: bool, hangs: bool = False) -> dict[str, float]:
    """Seconds of each kind; ``extras``: with the ball's heights and the board's places that the
    simulated procedure has, without which heights and depths are known less well; ``hangs``: the
    ball hangs at these heights."""
    virtual, wanted = VirtualProcedure(), CalibrateConfig()
    operator = Operator(
        list(virtual.raised_m[::-1]) if extras else [],
        len(virtual.board_at_m) if extras else 0,
        hangs,
    )

    def rest(*given: object) -> None:
        step = str(given[-1])
        hanging = step.startswith(HANGING)
        least_s = LOOK_S if hanging else steps._RESTING_DETECTIONS / INDEPENDENT_HZ
        checking_s = _HEIGHT_CHECK_S if step.startswith(RAISED) else 0.0
        operator.look(least_s + steps._OTHERS_S + checking_s)()

    session = SimpleNamespace(
        done=lambda step: step == EMPTY,
        around_count=0,
        balls=(),
        raised=[],
        raised_as=lambda _: {},
        raised_enough=False,
        wall_count=0,
    )
    config = SimpleNamespace(calibrate=wanted, reference="")
    sessions = chain([None], repeat(session))
    with (
        patch.multiple(
            "click", prompt=operator.prompt, confirm=operator.confirm, echo=operator.read
        ),
        patch("station.calibration.guide.operator.time.sleep", operator.wait),
        patch.object(Guide, "progress", lambda *_, **__: None),
        patch.multiple(
            guided,
            look_at_empty_booth=operator.look(steps._EMPTY_FRAMES / FRAME_RATE_HZ),
            look_at_wall=operator.look(steps._WALL_FRAMES / FRAME_RATE_HZ),
            wave_ball=operator.look(wanted.waving_s),
            coverage_so_far=lambda *_: SimpleNamespace(enough=False),
        ),
        patch.object(attempt, "rest_ball", rest),
        patch.multiple(
            Procedure,
            feed=_NoFeed,
            remark_on_ghosts=lambda *_: None,
            check_station=lambda _: None,
            unfinished_session=lambda _: next(sessions),
            solve=lambda _: operator.look(SOLVING_S)(),
        ),
    ):
        guide = Guide(attended=True, countdown_s=wanted.countdown_s)
        store = SimpleNamespace(resumable=lambda: None)
        Procedure(cast(Any, config), cast(Any, store), None, guide).run()
    return operator.spent_s


def print_procedure() -> None:
    """The bar, with and without what is offered beyond ball, mark and floor."""
    print("\nprocedure of one person (people's times assumed, the guide's own steps)")
    for extras, hangs, name in (
        (False, False, "ball, mark, floor"),
        (True, False, "with stand and board"),
        (True, True, "with hook and board"),
    ):
        spent_s = procedure_seconds(extras=extras, hangs=hangs)
        total_s = sum(spent_s.values())
        parts = ", ".join(f"{what} {seconds:.0f}" for what, seconds in spent_s.items())
        verdict = "met" if total_s <= BAR_S else "MISSED"
        print(f"  {name:<22}{total_s:>5.0f} s  <= {BAR_S:g}  {verdict}   ({parts})")
