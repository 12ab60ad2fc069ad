"""People's sizes, and generated bodies that have them.
What the generator is and how a model is learned from its bodies belong one folder up.
"""
