"""Scans as their folders tell of them: index, tables, comparisons, exports.
Commands, the console and the hand-over use it; how it reaches them belongs to those.
"""
