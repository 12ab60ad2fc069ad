"""The body model: a body from pose and shape, and its derivatives.
Nothing here knows of clouds, cameras or training data.
"""
