"""The console: the operator's page and the API, using the same endpoint as the commands.
Permissions are in `security`, live data in `live`, requests in `api`.
"""
