"""The operator's commands while a booth runs."""
