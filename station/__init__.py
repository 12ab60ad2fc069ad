"""What runs in the booth: sensors, clocks, framesets, calibration, scans, the operator."""

__version__ = "0.1.0"
