"""A depth camera's images: where they jump, their systematic error, their files.
Pure mathematics and bytes: of the station it imports nothing.
"""
