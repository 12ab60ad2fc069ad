"""Docstrings begin with a noun or a verb, not with a question word."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RIDDLE = re.compile(r"(Of|What|Whom|Whose|Who|Why|Where|When|How|Which|Until)\b")
"""Openings that leave out their subject; "Whether ..." says that a value is a truth value."""


def _docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every string that stands as a statement: docstrings, also of constants."""
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield node.lineno, text.strip()


@pytest.mark.parametrize("folder", ["station", "workers", "deploy", "tests"])
def test_a_docstring_begins_with_a_noun_or_a_verb(folder: str) -> None:
    offenders = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, text in _docstrings(path)
        if RIDDLE.match(text)
    ]
    assert offenders == [], "\n".join(offenders)
