"""Calibration of a booth: the cameras' poses and sensors, and the check for moved cameras.
The calibration file itself is `station.core.rig`.
"""
