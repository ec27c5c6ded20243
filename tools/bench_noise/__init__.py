"""Does ray tracing to a noise target reach it? Each run's estimate and target against a long reference."""
