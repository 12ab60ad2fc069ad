"""Depth sensors behind one interface: drivers, recordings, device clocks.
Simulated sensors live in `station.simulation`; frames of several cameras meet in `station.booth`.
"""
