"""Information about scans, read from their folders: index, tables, comparisons, exports. It is used
by the commands, the console and the hand-over.
"""
