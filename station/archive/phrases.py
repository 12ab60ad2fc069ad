"""Sentences that the booth says of scans and cameras, in the reader's language. Pure.

Processes speak English sentences, joined by "; ". They are put into Chinese where they are shown:
the page and the printed sheet look them up in `phrases.json`, from sentences with gaps to Chinese
ones with the same gaps. A {GAP} in capitals holds sentences of the table; any other {gap} holds a
name or a number and stays as it is. A test holds the table complete.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from station.core.words.terms import Language

PHRASES = Path(__file__).parent / "phrases.json"
_GAP = re.compile(r"\{(\w+)\}")
_BETWEEN = re.compile(r"; (?![^(]*\))")
"""Between sentences; what stands in brackets is a part of its sentence."""


def in_language(text: str, language: Language) -> str:
    """A sentence, or several with "; " between them; what the table lacks stays English."""
    if language == "en":
        return text
    return "；".join(_piece(piece) for piece in _BETWEEN.split(text))


def untranslated(text: str) -> list[str]:
    """The pieces of a text, and of what fills its gaps, that the table lacks."""
    missing: list[str] = []
    for piece in _BETWEEN.split(text):
        found = _find(piece)
        missing += (
            [piece]
            if found is None
            else [m for name, gap in found[1].items() if name.isupper() for m in untranslated(gap)]
        )
    return missing


def _piece(text: str) -> str:
    found = _find(text)
    if found is None:
        return text
    template, gaps = found
    return template.format(
        **{
            name: in_language(value, "zh") if name.isupper() else value
            for name, value in gaps.items()
        }
    )


def _find(text: str) -> tuple[str, dict[str, str]] | None:
    """The Chinese sentence and what fills its gaps."""
    for pattern, template in _table():
        if (found := pattern.fullmatch(text)) is not None:
            return template, found.groupdict()
    return None


@lru_cache(maxsize=1)
def _table() -> list[tuple[re.Pattern[str], str]]:
    """Patterns with their translation; those that leave least to a gap first."""
    phrases: Mapping[str, str] = json.loads(PHRASES.read_text(encoding="utf-8"))
    fixed = sorted(phrases.items(), key=lambda item: -len(_GAP.sub("", item[0])))
    return [(_pattern(english), chinese) for english, chinese in fixed]


def _pattern(english: str) -> re.Pattern[str]:
    parts = _GAP.split(english)
    # Text and names of gaps take turns.
    return re.compile(
        "".join(
            f"(?P<{part}>.*?)" if index % 2 else re.escape(part) for index, part in enumerate(parts)
        ),
        re.DOTALL,
    )
