"""Shared by all programs of the booth: errors, files, geometry, configuration, a process's life,
the formats on disk and the facts of lenses and sensors. No sockets, no sensors, no processes.
"""
