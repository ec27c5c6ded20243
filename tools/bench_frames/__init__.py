"""Our frames against path tracing + Open Image Denoise at equal time, and how much both flicker: `make bench-frames`.

scene      a workspace opened for timing: Mitsuba, plan, views, display
reference  many samples per pixel, two halves, kept on disk
rival      the ladder: samples x what the denoiser is given
ours       G-buffer, base image, network
ladder     best picture by milliseconds, lead at equal time, crossover (numpy only)
motion     reprojection by known motion, flicker (numpy only)
stability  an orbit of close frames
document   JSON and Markdown
"""
