"""Setting up a booth and keeping it: tasks of an administrator. No process of the booth imports
this."""
