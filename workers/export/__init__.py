"""Files that a fitting room opens: meshes, pictures, tables."""
