"""Baselines from the literature: active learning on rasterised images, benchmarked, not offered by `dnrpipe select`."""
