"""A depth camera: lenses that are possible, jumps in its images, their systematic error and files.
Pure mathematics and bytes: of the station it imports nothing.
"""
