"""What crosses a socket between the booth's processes: messages, topics, and how sockets are made.
What a process does with a message belongs to the process.
"""
