"""The surface beyond the model: it is laid on the points and kept free of crossings.
Pose and shape are estimated in `workers.scape.fit`.
"""
