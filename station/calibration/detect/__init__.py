"""What one camera sees of a ball, a board, the floor and the empty booth, reduced to measurements.
Nothing here knows of a second camera.
"""
