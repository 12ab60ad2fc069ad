"""The console: the operator's page and the API, over the same endpoint that the commands use.
Who may do what is in `security`, what changes by the second in `live`, requests in `api`.
"""
