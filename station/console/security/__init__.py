"""Who may use the console: password, sessions, tokens, where requests may come from, the log of it.
Nothing here knows what a request is for.
"""
