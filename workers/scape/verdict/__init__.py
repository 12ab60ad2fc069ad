"""The verdict on a fit: what was seen of the body, what the surface does not explain, poses that
nobody has, and the reasons to scan again in the operator's words.
"""
