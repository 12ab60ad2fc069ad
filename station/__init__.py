"""The booth's programs: sensors, clocks, framesets, calibration, scans, the operator's commands."""

__version__ = "0.1.0"
