"""Setting up a booth and keeping it: what is done by an administrator, seldom, with the booth at
rest. No process of the booth imports this."""
