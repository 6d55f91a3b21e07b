"""Objects: meshes, the scenes cut from them, and a scene's error against its mesh.

A setting names an object and a skin. Nothing here imports another room of training.
"""
