"""The SCAPE body model (Anguelov et al. 2005): the model, its fit to a cloud, how it is learned.
Measuring a fitted body belongs to `workers.measure`.
"""
