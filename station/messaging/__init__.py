"""Messages between the booth's processes: their fields, the topics, and how sockets are made; and
the file that tells them of the console's countdown.

What a process does with a message belongs to the process.
"""
