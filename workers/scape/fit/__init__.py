"""The fit of the model to a cloud: start, joint estimation, the paper's method.
Learning the model (`workers.scape.learn`) is never imported here.
"""
