"""The processes of a running booth: capture, matching, scans, the operator's commands.
Calibration has a package of its own, and reconstruction runs in `workers`.
"""
