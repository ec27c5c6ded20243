"""Baselines from the literature: active learning on rasterised images, benchmarked, not offered by `dnrpipe select`.

batches        the policy: train on the views chosen so far, look where that leaves doubts, choose on
ensemble       doubt is disagreement of several renderers
variance       doubt is a learned variance
pieces         doubts of pixels, summed up over surface and direction
active_worker  one selection, in a worker process
"""
