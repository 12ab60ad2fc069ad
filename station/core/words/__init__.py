"""Measurements as the booth and its workers tell them alike: names, and tables' common parts."""
