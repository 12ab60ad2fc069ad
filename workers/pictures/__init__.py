"""Pictures of bodies without a display.
What a picture is of, and where it is written, is decided by the caller.
"""
