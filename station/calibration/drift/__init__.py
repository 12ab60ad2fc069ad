"""Detection of cameras that have moved since the calibration: the check of scans and of the booth.

The estimate itself belongs to `moves`, calibrating anew to `guide` and `solve`.
"""
