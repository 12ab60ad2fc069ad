"""Modules that come before a command is loaded; they import next to nothing."""
