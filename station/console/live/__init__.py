"""The booth as it changes: events, depth pictures, scans being taken, a calibration being done.
No HTTP; `api` shows it.
"""
