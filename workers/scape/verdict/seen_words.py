"""Words on how much of the body was seen (pure)."""

from __future__ import annotations


def little_seen(share: float, what: str, *, cameras: bool) -> str:
    """Sentence on a part or side of which too small a share was seen.

    Args:
        cameras: whether the scan comes from the booth's; a bare cloud has none.
    """
    percent = f"{100 * share:.0f}"
    if percent == "0":
        return f"nothing of the {what} was seen"
    if cameras:
        return f"the cameras saw only {percent} % of the {what}"
    return f"the cloud shows only {percent} % of the {what}"


def many_hardly_seen(count: int, total: int, *, cameras: bool) -> str:
    """Sentence on more parts than can be named."""
    if cameras:
        return f"the cameras hardly saw {count} of {total} parts of the body"
    return f"the cloud hardly shows {count} of {total} parts of the body"
