"""Values of a JSON document: numbers and text.

Text, true and null are no numbers, though Python takes them for some.
"""

from __future__ import annotations

import json
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def shown(found: object) -> str:
    """A few words on what stands in a document."""
    if isinstance(found, dict):
        return "an object {...}"
    return "a list" if isinstance(found, list) else json.dumps(found)[:40]


def number(name: str, found: object) -> float:
    """The number of a field.

    Raises:
        ValueError: it is none; the message has the field's name.
    """
    if not _is_number(found):
        raise ValueError(f"{name} is {shown(found)}, not a number")
    try:
        return float(found)  # type: ignore[arg-type]  # it was looked at
    except OverflowError:
        raise ValueError(f"{name} is too large") from None


def whole(name: str, found: object, *, parts: bool = False) -> int:
    """The whole number of a field; some programs write it with a decimal point.

    Args:
        parts: leave out what is behind the point, as of a moment that was computed.

    Raises:
        ValueError: it is none; the message has the field's name.
    """
    value = number(name, found)
    if not (value.is_integer() or (parts and math.isfinite(value))):
        raise ValueError(f"{name} is {shown(found)}, not a whole number")
    return int(found)  # type: ignore[call-overload]  # it was looked at


def text(name: str, found: object) -> str:
    """The text of a field.

    Raises:
        ValueError: it is none; the message has the field's name.
    """
    if not isinstance(found, str):
        raise ValueError(f"{name} is {shown(found)}, not text")
    # Half of a UTF-16 pair: JSON may escape it, but no file of the result can hold it.
    if any("\ud800" <= c <= "\udfff" for c in found):
        raise ValueError(f"{name} has characters that no file can hold")
    return found


def array_of(found: object) -> Array | None:
    """Numbers in a list, or in lists of one length in one another; None if they are not that."""
    try:
        return np.asarray(found, np.float64) if _all_numbers(found) else None
    except (ValueError, OverflowError, RecursionError):
        return None


def _all_numbers(found: object) -> bool:
    if isinstance(found, list | tuple):
        return all(_all_numbers(part) for part in found)
    return _is_number(found)


def _is_number(found: object) -> bool:
    return isinstance(found, int | float) and not isinstance(found, bool)
