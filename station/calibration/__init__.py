"""Finding the cameras' places and depth errors, and noticing a camera that moved.
The calibration file itself is `station.core.rig`.
"""
