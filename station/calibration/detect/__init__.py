"""Detections by one camera of a ball, a board, the floor and the empty booth.
Nothing here knows of a second camera.
"""
