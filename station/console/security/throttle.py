"""A limit on how often a password may be tried. Pure."""

from __future__ import annotations

from collections import OrderedDict

FREE_TRIES = 5
"""Tries without a pause: a person mistypes, a program tries thousands."""
LONGEST_PAUSE_S = 60.0
_ADDRESSES_KEPT = 1000
AT_ONCE = 2
"""Passwords that are checked at the same time, whoever sends them: each takes 64 MiB (argon2)."""


class LoginThrottle:
    """Growing pauses for an address that sends wrong passwords."""

    def __init__(self) -> None:
        self._failures: OrderedDict[str, tuple[int, float]] = OrderedDict()
        """Address -> number of failures in a row, and the time of the last one in seconds."""

    def wait_s(self, address: str, now_s: float) -> float:
        """Seconds that this address has to wait before its next try; 0 if it need not."""
        count, last_s = self._failures.get(address, (0, 0.0))
        return max(0.0, last_s + pause_s(count) - now_s)

    def failed(self, address: str, now_s: float) -> None:
        count, _ = self._failures.pop(address, (0, 0.0))
        self._failures[address] = (count + 1, now_s)
        while len(self._failures) > _ADDRESSES_KEPT:
            self._failures.popitem(last=False)

    def succeeded(self, address: str) -> None:
        self._failures.pop(address, None)


def pause_s(failures: int) -> float:
    """After so many wrong passwords in a row: 0 five times, then 1, 2, 4 ... 60 s."""
    if failures < FREE_TRIES:
        return 0.0
    return float(min(LONGEST_PAUSE_S, 2.0 ** min(failures - FREE_TRIES, 10)))
