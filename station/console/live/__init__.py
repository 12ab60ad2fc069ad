"""What changes by the second: events, depth pictures, scans being taken, a calibration being done.
No HTTP; `api` shows it.
"""
