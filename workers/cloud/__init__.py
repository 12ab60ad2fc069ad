"""From a scan bundle's depth frames, or a file of points, to one clean cloud of one person.
Fitting a body to the cloud belongs to `workers.scape`.
"""
