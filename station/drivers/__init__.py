"""Depth sensors behind one interface."""
