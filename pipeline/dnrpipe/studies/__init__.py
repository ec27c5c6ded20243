"""Measurements about the pipeline; no stage knows them.

cells          train and measure one (scene, variant, seed): what the studies share
ablation       variants of the renderer, at equal time
selectbench    policies of view selection
frontier       quality against seconds, with baselines
frames         a frame of ours and of path tracing + denoiser, timed
planning       what a budget of time buys, before it is spent
effect_costs   what each light-transport effect costs
"""
