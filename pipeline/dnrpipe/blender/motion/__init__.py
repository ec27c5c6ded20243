"""What changes over the frames of a shot."""
