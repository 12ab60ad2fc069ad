"""The guided procedure of a calibration: frames, steps, records on disk.
The mathematics is in `detect` and `solve`.
"""
