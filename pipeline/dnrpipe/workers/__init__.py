"""Task lists on worker processes."""
