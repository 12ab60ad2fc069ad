"""Evidence about a body in points, images and the floor: correspondences, outlines, rims, crown.
How the body follows is decided in `workers.scape.fit`.
"""
