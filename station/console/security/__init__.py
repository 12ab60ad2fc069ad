"""Access to the console: password, sessions, tokens, origins of requests, the log of it.
Nothing here knows what a request is for.
"""
