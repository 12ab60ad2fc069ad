"""What every program of the booth shares: errors, files, geometry, configuration, a process's life,
the formats on disk and the facts of lenses and sensors. No sockets, no sensors, no processes.
"""
