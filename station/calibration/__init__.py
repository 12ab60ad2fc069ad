"""Where the cameras are: the rig itself, how it is found, and how staleness is noticed."""
