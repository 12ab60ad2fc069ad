"""Tailor's measurements: the table that defines them, their lines, values and intervals.
Fitting belongs to `workers.scape`, writing tables to `workers.export`.
"""
