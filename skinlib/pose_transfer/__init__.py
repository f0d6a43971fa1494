"""Pose transfer between meshes that share neither vertices nor a rig."""
