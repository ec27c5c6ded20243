"""What a frame costs and how good it is: ours, and path tracing with a denoiser, timed in one process."""
