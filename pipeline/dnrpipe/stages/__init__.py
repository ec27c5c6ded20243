"""The pipeline itself: each stage reads files of a workspace and writes files of it."""
