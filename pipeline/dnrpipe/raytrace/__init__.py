"""Path tracing with Mitsuba 3: the only package that imports mitsuba, and only in worker processes."""
