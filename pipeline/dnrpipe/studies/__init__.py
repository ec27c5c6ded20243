"""Measurements about the pipeline; no stage knows them."""
