"""What leads an operator through a calibration: frames, steps, what is kept on disk.
The mathematics is in `detect` and `solve`.
"""
