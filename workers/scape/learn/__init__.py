"""How the model is learned from a database of bodies, and how it is evaluated.
Nothing that runs in a booth imports this.
"""
