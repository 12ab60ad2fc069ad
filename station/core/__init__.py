"""Shared by all programs of the booth: errors, files, geometry, configuration, the life cycle of
processes, the formats on disk and the parameters of lenses and sensors. No sockets, no sensors, no
processes.
"""
