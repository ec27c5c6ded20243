"""Scene files in: open, complete (camera, light), list what is missing."""
