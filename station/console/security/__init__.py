"""Access to the console: password, sessions, tokens, origins of requests, and the log of it.
Nothing here depends on the content of a request.
"""
