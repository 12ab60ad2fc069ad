"""Whether a camera has moved since it was calibrated.
Calibrating anew belongs to `guide` and `solve`.
"""
