"""Errors that a user can act upon.

Each message is one line that names the file, camera or key at fault and says what to do.
Commands print it as ``error: <message>`` and exit with 1; anything else that escapes is a defect.
"""

from __future__ import annotations


class BoothError(Exception):
    """Something that the user, not the programmer, has to put right."""


class ConfigError(BoothError):
    """booth.toml cannot be used as it is written."""


class FormatError(BoothError):
    """A file is torn, of another kind or of a version that this program does not read."""


class DiskReadError(FormatError):
    """The disk refused to read a file, which says nothing of its content: it may read it later."""


class BundleError(FormatError):
    """A scan bundle is incomplete or contradicts itself."""


class CalibrationError(BoothError):
    """The calibration is missing, stale or cannot be computed from what was seen."""


class DriverError(BoothError):
    """A sensor cannot be opened or has stopped."""


class SpoolError(BoothError):
    """The spool cannot take, hold or hand out a scan."""


class InputError(BoothError):
    """The data are readable but hold no body that can be reconstructed."""
