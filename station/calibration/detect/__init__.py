"""Detection in one camera's images: the ball, a board, the floor and the empty booth.
Nothing here knows of a second camera.
"""
