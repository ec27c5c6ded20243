"""The evaluated scene as triangles, and their places in the atlas."""
