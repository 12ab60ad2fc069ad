"""Messages between the booth's processes: their fields, the topics, and how sockets are made.
What a process does with a message belongs to the process.
"""
