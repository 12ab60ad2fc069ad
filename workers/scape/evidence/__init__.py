"""What points, images and the floor say about a body: correspondences, outlines, rims, crown.
How the body follows is decided in `workers.scape.fit`.
"""
