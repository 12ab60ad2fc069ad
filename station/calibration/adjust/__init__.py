"""The joint adjustment of all unknowns of cameras, sensors, ball and floor.
Pure mathematics: arrays in, the most probable state and its covariance out. Whether the result is
good enough is decided in `solve`.
"""
