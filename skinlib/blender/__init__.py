"""Blender as a helper: `.blend` and `.fbx` files in and out, and the add-on.

Blender runs in a process of its own: it wants its own Python and its own numpy.
"""
