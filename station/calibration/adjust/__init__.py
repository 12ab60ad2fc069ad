"""The joint solution: what is unknown of cameras, sensors, ball and floor, and its adjustment.
Pure mathematics: arrays in, the likeliest state and its covariance out; no verdict.
"""
