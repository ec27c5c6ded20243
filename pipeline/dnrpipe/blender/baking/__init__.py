"""Socket values that have no counterpart in Mitsuba -> images in the atlas."""
