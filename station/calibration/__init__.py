"""Where the cameras are, how this is found out, and how a camera that moved is noticed.
The calibration file itself is `station.core.rig`.
"""
