"""The files of a result: meshes, pictures, tables.
The numbers in them are computed elsewhere.
"""
