"""Learning of the body model from generated bodies, and its evaluation on held-out ones.
Nothing that runs in a booth imports this package; it needs the train extra.
"""
