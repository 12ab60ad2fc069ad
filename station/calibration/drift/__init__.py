"""Detection of cameras that have moved since the calibration.
Calibrating anew belongs to `guide` and `solve`.
"""
