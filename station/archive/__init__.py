"""What is known of scans, read from their folders: the index, tables, comparisons, exports.
Commands, the console and the hand-over use it; how it reaches them belongs to those.
"""
