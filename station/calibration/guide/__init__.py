"""The guided calibration: frames, steps, the operator's screen, and the session on disk.
The mathematics is in `detect` and `solve`.
"""
