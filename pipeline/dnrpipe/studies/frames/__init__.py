"""What a frame costs and how good it is: ours, and path tracing with a denoiser, timed in one process.

scene         a workspace opened for timing: Mitsuba, plan, views, display
baselines     path tracing: samples x what the denoiser is given
ours          G-buffer, base image, network
pareto_front  best picture by milliseconds, crossover (numpy only)
"""
