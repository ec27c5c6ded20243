"""G-buffers, coverage and rasterised colour of a view."""
