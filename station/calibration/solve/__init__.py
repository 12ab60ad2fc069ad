"""All cameras' poses and depth corrections from their detections, and whether they can be trusted.
Pure mathematics: no files, no frames, no operator.
"""
