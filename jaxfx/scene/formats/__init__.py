"""Readers of mesh files, a module for each format.

Each has `read(path, data)`, which returns the parts of a file, and the names of what it leaves
out. `scene.load` chooses between them.
"""
