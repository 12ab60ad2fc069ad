"""Estimates of how far a camera stands from where it was, from what stands still in its view.

Mathematics alone: files and processes are the affair of `station.calibration.drift`.
"""
